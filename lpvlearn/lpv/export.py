"""Frozen models over a grid, in the form that other programs take."""

from __future__ import annotations

import os
import re
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.statespace import StateSpace
from ..systems.whole_files import whole_file
from ..validation import file_name, optional_module

Array = NDArray[np.float64]

# Of the matrices over a grid; the second axis of A needs a name of its own.
_DIMENSIONS = {
    "A": ("state", "from_state"),
    "B": ("state", "input"),
    "C": ("output", "state"),
    "D": ("output", "input"),
}

_LONGEST = 63  # characters of a name in MATLAB


class Grid(NamedTuple):
    """Frozen models in continuous time, and what is known of their places."""

    models: Sequence[StateSpace]
    points: Array  # (n_points, n_scheduling)
    offsets: dict[str, Array]  # "u", "y", "x": (n_points, size)
    scheduling: Sequence[Hashable]
    inputs: Sequence[Hashable]
    outputs: Sequence[Hashable]
    units: Mapping[str, str]  # by name, where known


def control_models(grid: Grid) -> list[Any]:
    """The models as `control.StateSpace`, named after their places.

    A point is no part of a name there: 0.5 becomes 0p5, a column "u.1" is "u_1".
    """
    inputs, outputs = (
        [str(name).replace(".", "_") for name in names]
        for names in (grid.inputs, grid.outputs)
    )
    found = []
    for model, place in zip(grid.models, grid.points, strict=True):
        values = zip(grid.scheduling, place, strict=True)
        name = ", ".join(f"{variable}={value:g}" for variable, value in values)
        name = name.replace(".", "p")
        found.append(model.to_control(name=name, inputs=inputs, outputs=outputs))
    return found


def write_mat(path: str | os.PathLike[str], grid: Grid) -> None:
    """Write the variables of `LPVStateSpace.to_mat`; a file there stays whole."""
    order, shape = _rectangular(grid.points)
    models = [grid.models[k] for k in order]

    def over_grid(values: Sequence[Array]) -> Array:
        """Arrays of one shape, with the axes of the grid behind their own."""
        stacked = np.stack([values[k] for k in order], axis=-1)
        return stacked.reshape(stacked.shape[:-1] + shape)

    n_states = len(models[0].A)
    offsets = np.empty(shape, dtype=[(name, object) for name in ("dx", "x", "u", "y")])
    for place, k in zip(np.ndindex(shape), order, strict=True):
        own = {name: values[k][:, None] for name, values in grid.offsets.items()}
        offsets[place] = (np.zeros((n_states, 1)), own["x"], own["u"], own["y"])
    content: dict[str, Any] = {
        name: over_grid([getattr(model, name) for model in grid.models])
        for name in "ABCD"
    }
    content |= {
        "Ts": 0.0,
        "InputDelay": models[0].input_delay[:, None],
        "SamplingGrid": {
            name: over_grid(list(column))
            for name, column in zip(
                _identifiers(grid.scheduling), grid.points.T, strict=True
            )
        },
        "offsets": offsets,
    }
    for side, names in (("Input", grid.inputs), ("Output", grid.outputs)):
        units = [grid.units.get(str(name), "") for name in names]
        for what, texts in (("Name", map(str, names)), ("Unit", units)):
            cells = np.array([[text] for text in texts], dtype=object)
            content[f"{side}{what}"] = cells
    from scipy.io import savemat  # slow to import

    with whole_file(file_name(path)) as file:
        savemat(file, content, long_field_names=True)


def as_dataset(grid: Grid) -> Any:
    """The models as an `xarray.Dataset`, see `LPVStateSpace.to_xarray`."""
    Dataset = optional_module("xarray", "to_xarray", "xarray").Dataset

    names = [str(name) for name in grid.scheduling]
    order, shape = _rectangular(grid.points)
    points, n = grid.points[order], grid.points.shape[1]
    places: dict[str, Any] = {
        name: ("point", column) for name, column in zip(names, points.T, strict=True)
    }
    over = ["point"]
    axes = [np.unique(column) for column in points.T]
    if n == 1 or shape == tuple(map(len, axes)):
        over, axes = names, [points[:, 0]] if n == 1 else axes
        places = dict(zip(names, axes, strict=True))
    sizes = [len(axis) for axis in axes] if over == names else [len(points)]

    def part(values: Sequence[Array], *dims: str) -> Any:
        stacked = np.stack([values[k] for k in order])
        return [*over, *dims], stacked.reshape((*sizes, *stacked.shape[1:]))

    places["input"] = [str(name) for name in grid.inputs]
    places["output"] = [str(name) for name in grid.outputs]
    found = Dataset(
        {
            name: part([getattr(model, name) for model in grid.models], *dims)
            for name, dims in _DIMENSIONS.items()
        }
        | {
            f"{letter}0": part(list(grid.offsets[letter]), dim)
            for letter, dim in (("u", "input"), ("y", "output"), ("x", "state"))
        }
        | {"input_delay": ("input", grid.models[0].input_delay)},
        places,
    )
    for name in names:
        if name in grid.units:
            found[name].attrs["units"] = grid.units[name]
    for side in ("input", "output"):
        units = [grid.units.get(name, "") for name in found[side].values.tolist()]
        found = found.assign_coords({f"{side}_unit": (side, units)})
    return found


def _rectangular(points: Array) -> tuple[NDArray[np.intp], tuple[int, ...]]:
    """Order and shape of the points: a full grid's, else (n_points, 1)."""
    order = np.lexsort(points.T[::-1])
    axes = [np.unique(column) for column in points.T]
    shape = tuple(len(axis) for axis in axes)
    full = len(shape) > 1 and int(np.prod(shape)) == len(points)
    if full:
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(points.shape)
        if np.array_equal(points[order], cells):
            return order, shape
    return np.arange(len(points)), (len(points), 1)


def _identifiers(names: Sequence[Hashable]) -> list[str]:
    """Names that MATLAB takes for fields, all of them different."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", str(name), flags=re.ASCII)
        plain = (plain if plain[:1].isalpha() else f"p{plain}")[:_LONGEST]
        while plain in found:
            plain = f"{plain[: _LONGEST - 1]}_"
        found.append(plain)
    return found
