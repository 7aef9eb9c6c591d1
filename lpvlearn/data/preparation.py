"""What is done to samples before identification: gaps, trends, and poor inputs.

Records are cut where a sample is missing, freed of their mean or straight line, and
refused where an input never changes; inputs that are combinations of each other are
replaced by independent ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..exceptions import warn
from ..validation import SQUARED, listed
from .experiments import Experiment, read_experiments

Array = NDArray[np.float64]

Pairs = list[tuple[Array, Array]]

DETRENDS = (None, "constant", "linear")  # by the number of signals in a trend

# Relative singular value below which inputs count as collinear, and the ratio of the
# eigenvalues of their Gram matrix below which that is looked into: its rounding hides
# ratios of singular values below 1e-8, well above the first.
_COLLINEAR, _SUSPECTED = 1e-10, 1e-12

# The same of inputs that only rounding tells apart, the part of its step that what it
# leaves moves by, and decimal places of numbers that are looked for.
_FAINT, _ROUNDED, _PLACES = 1e-3, 0.5, 9

_FEW = 5  # labels that a message lists


def read_runs(
    estimator: Any,
    X: Any,
    y: Any,
    *,
    split: bool,
    outputs: bool = True,
    cut: bool = True,
    **options: Any,
) -> list[Experiment]:
    """Experiments of a table, as `read_experiments` reads them with these options.

    With `split` they are cut where samples are missing, if there is a `y`: a simulation
    alone needs all inputs. Without `outputs` these may be missing, and cut nothing;
    without `cut` nothing does.
    """
    split = split and y is not None
    allowed = "Xy" if split else "" if outputs else "y"
    found = read_experiments(estimator, X, y, allow_missing=allowed, **options)
    if not (split and cut):
        return found
    if outputs:
        parts = split_at_gaps(found)
        _warn_of_empty(found, parts)
        return parts
    return [run for e in found for run in complete_runs(e, 1, outputs=False)]


def _warn_of_empty(
    experiments: Sequence[Experiment], parts: Sequence[Experiment]
) -> None:
    """Tell of experiments of which no part is left."""
    left = {part.label for part in parts}
    empty = [repr(e.label) for e in experiments if e.label not in left]
    if empty:
        warn(
            f"experiment(s) {listed(empty, _FEW)} have no two consecutive samples "
            "of which nothing is missing (NaN), and are left out, with their operating "
            "points. Check their columns, or leave their rows out yourself."
        )


def has_gaps(experiment: Experiment) -> bool:
    """Whether a sample of an experiment is missing, or a part of one."""
    return bool(experiment.breaks) or not _is_complete(experiment).all()


def _is_complete(experiment: Experiment, outputs: bool = True) -> NDArray[np.bool_]:
    """Samples of which no value is missing, of outputs only where asked."""
    signals = [experiment.inputs, experiment.scheduling]
    signals += [experiment.outputs] if outputs else []
    known = [np.isfinite(x).all(axis=1) for x in signals if x is not None]
    return np.logical_and.reduce(known)


def split_at_gaps(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Cut experiments where a value is missing (NaN), or time has a hole.

    Every run of at least two complete samples keeps its label, and starts from an
    initial state of its own. Raises a ValueError if there is none.

    Examples
    --------
    >>> import numpy as np
    >>> u = np.array([[1.0], [2.0], [np.nan], [4.0], [5.0], [6.0]])
    >>> whole = Experiment("a", np.arange(6), u, np.zeros((6, 1)))
    >>> [part.rows.tolist() for part in split_at_gaps([whole])]
    [[0, 1], [3, 4, 5]]
    """
    parts = [part for e in experiments for part in complete_runs(e)]
    if not parts:
        raise ValueError(
            "missing='split' needs runs of at least 2 consecutive complete samples. "
            "Got none: check X and y for columns that are NaN throughout."
        )
    return parts


def complete_runs(
    experiment: Experiment, shortest: int = 2, *, outputs: bool = True
) -> list[Experiment]:
    """Runs of at least `shortest` consecutive samples of which nothing is missing.

    Without `outputs`, these may be missing.
    """
    complete = _is_complete(experiment, outputs)
    edges = np.flatnonzero(np.diff(complete)) + 1
    cuts = np.unique([0, *edges, *experiment.breaks, len(complete)])
    return [
        part_of(experiment, slice(start, stop))
        for start, stop in pairwise(cuts)
        if complete[start] and stop - start >= shortest
    ]


def unbroken_runs(experiment: Experiment) -> list[Experiment]:
    """The parts between holes in time; values may be missing in them."""
    if not experiment.breaks:
        return [experiment]
    edges = [0, *experiment.breaks, len(experiment.rows)]
    return [part_of(experiment, slice(*part)) for part in pairwise(edges)]


def part_of(experiment: Experiment, part: slice) -> Experiment:
    def cut(values: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if values is None else values[part]

    return replace(
        experiment,
        rows=experiment.rows[part],
        inputs=experiment.inputs[part],
        outputs=cut(experiment.outputs),
        estimated=cut(experiment.estimated),
        scheduling=cut(experiment.scheduling),
        breaks=(),
    )


def remove_trends(pairs: Pairs, detrend: str | None) -> tuple[Pairs, Array, Array]:
    """Subtract its mean or its straight line from every channel of every experiment.

    The pairs come back with the offsets of inputs and outputs, a row per experiment:
    means over its samples, zero with ``detrend=None``.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(4.0)[:, None]
    >>> pairs, u0, y0 = remove_trends([(t, 2.0 * t + 1.0)], "linear")
    >>> u0, y0, np.abs(pairs[0][1]).max() < 1e-12
    (array([[1.5]]), array([[4.]]), np.True_)
    """
    if detrend is None:
        none = [np.zeros((len(pairs), values.shape[1])) for values in pairs[0]]
        return pairs, none[0], none[1]
    means = [np.array([pair[k].mean(axis=0) for pair in pairs]) for k in (0, 1)]
    degree = 0 if detrend == "constant" else 1
    cleaned = [(u - _trend(u, degree), y - _trend(y, degree)) for u, y in pairs]
    return cleaned, means[0], means[1]


def _trend(values: Array, degree: int) -> Array:
    mean = values.mean(axis=0)
    if degree == 0 or len(values) < 3:
        return np.broadcast_to(mean, values.shape)
    t = np.linspace(-1.0, 1.0, len(values))
    slope = t @ values / (t @ t)
    return mean + t[:, None] * slope


def constant_columns(signals: Sequence[Array]) -> NDArray[np.intp]:
    """Columns that have one and the same value in all samples of all experiments."""
    low = np.min([part.min(axis=0) for part in signals], axis=0)
    high = np.max([part.max(axis=0) for part in signals], axis=0)
    return np.flatnonzero(low == high)


def independent_inputs(inputs: Sequence[Array]) -> Array | None:
    """P (n_inputs, rank) such that the columns of ``u P`` are independent, or None.

    A model of ``u P`` with input matrix B is the smallest one of the original inputs
    (no column zero) with ``B P.T``, inputs scaled to their largest value. None where
    they are independent as they are, or the samples too few to tell.

    Examples
    --------
    >>> import numpy as np
    >>> u = np.array([[1.0], [2.0], [-1.0]])
    >>> independent_inputs([u]) is None
    True
    >>> independent_inputs([np.hstack([u, u])]).shape
    (2, 1)
    """
    n_samples, n_inputs = sum(map(len, inputs)), inputs[0].shape[1]
    scale = np.max([np.abs(u).max(axis=0) for u in inputs if len(u)], axis=0)
    scale[scale == 0.0] = 1.0  # of one that rests in these
    # Only a suspicion is checked on the samples themselves.
    values = np.linalg.eigvalsh(sum(v.T @ v for v in (u / scale for u in inputs)))
    if n_samples < n_inputs or values[0] > _SUSPECTED * values[-1]:
        return None
    _, s, right = np.linalg.svd(np.linalg.qr(np.vstack(inputs) / scale)[1])
    rank = int(np.sum(s > _COLLINEAR * s[0]))
    return None if rank == n_inputs else (right[:rank] / scale).T


class Rounded(NamedTuple):
    """Inputs of which some differ from collinear ones by the rounding of numbers alone.

    As shares of a whole, whose sum is constant in every experiment but for the last
    digit. Directions are columns, in units of the inputs.
    """

    exact: list[Array]  # the inputs without that ripple
    faint: Array  # directions of the ripple
    others: Array

    @classmethod
    def of(cls, inputs: Sequence[Array]) -> Rounded | None:
        """None, mostly, where there is no such direction.

        Examples
        --------
        >>> import numpy as np
        >>> parts = np.random.default_rng(0).dirichlet([1, 1, 1], 50).round(4)
        >>> found = Rounded.of([parts])
        >>> both = parts, found.exact[0]
        >>> [int(np.linalg.matrix_rank(np.cov(u.T), 1e-12)) for u in both]
        [3, 2]
        >>> bool(np.abs(found.exact[0] - parts).max() < 1e-4), found.faint.shape
        (True, (3, 1))
        """
        n_inputs = inputs[0].shape[1]
        if n_inputs == 1 or sum(map(len, inputs)) <= n_inputs:
            return None
        moved = np.vstack([u - u.mean(axis=0) for u in inputs])
        scale = moved.std(axis=0)
        scale[scale == 0.0] = 1.0
        moved /= scale
        values, V = np.linalg.eigh(moved.T @ moved / len(moved))
        is_faint = values <= _FAINT**2 * values[-1]
        if not is_faint.any():
            return None
        step = np.array([_decimal_step(u) for u in np.vstack(inputs).T]) / scale
        ripple = (moved @ V).std(axis=0)
        is_faint &= ripple <= _ROUNDED * np.linalg.norm(V.T * step, axis=1)
        is_faint &= ripple > _COLLINEAR
        if not is_faint.any():
            return None
        faint = V[:, is_faint]
        exact = np.vstack(inputs) - (moved @ faint @ faint.T) * scale
        exact = np.split(exact, np.cumsum([len(u) for u in inputs])[:-1])
        return cls(exact, faint * scale[:, None], V[:, ~is_faint] * scale[:, None])


def _decimal_step(values: Array) -> float:
    """The last decimal place of numbers that were rounded to one; 0 if they were not.

    >>> _decimal_step(np.array([0.5, 20.25])), _decimal_step(np.array([100.0, 3.0]))
    (0.01, 1.0)
    >>> _decimal_step(np.array([1.0 / 3.0, 2.0]))
    0.0
    """
    for places in range(_PLACES):
        step = 10.0**-places
        if np.allclose(values, np.round(values, places), rtol=1e-12, atol=1e-9 * step):
            return step
    return 0.0


def check_excitation(pairs: Pairs, called: Callable[[int], str]) -> None:
    """Refuse a single sample, and inputs that never change or are next to nothing.

    Messages have an input as it is `called` by its column.
    """
    inputs = [u for u, _ in pairs]
    if max(len(u) for u in inputs) < 2:
        raise ValueError(
            "A dynamic model needs an experiment of at least 2 samples. Got n_samples "
            f"= {len(inputs)} in {len(inputs)} experiment(s) of 1 sample."
        )
    constant = constant_columns(inputs)
    if len(constant):
        k = constant[0]
        raise ValueError(
            f"Every input must vary. Got input {called(k)} "
            f"constant at {inputs[0][0, k] + 0.0:g}: "
            "its effect cannot be told from the initial state. Excite it, or leave it "
            "out of `inputs`; a column that is no input needs its role (`scheduling=`, "
            "`operating_point=`, `experiment=`)."
        )
    size = np.max([np.maximum(u.max(axis=0), -u.min(axis=0)) for u in inputs], axis=0)
    small = np.flatnonzero(size < 1.0 / SQUARED).tolist()
    if small:  # a model from it has huge entries
        k = small[0]
        raise ValueError(
            f"Every column of `inputs` must reach {1.0 / SQUARED:g}, as what is below "
            f"is zero when squared. Got input {called(k)} of at "
            f"most {size[k]:.3g}: give it in a smaller unit."
        )
