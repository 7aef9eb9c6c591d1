"""Models in files without code: a zip of one JSON text and the arrays it names.

`save` writes what a model is, `load` builds it anew: classes by a closed list of names,
every field of the form that `schema` gives it. Nothing in a file is ever run. Members
are stored, not compressed, and an array belongs to one field only, so that a file takes
a few times its size in memory at most.
"""

from __future__ import annotations

import inspect
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.lib import format as npy
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from ...exceptions import PLAIN_DTYPES, version
from ...systems.whole_files import whole_file
from ...validation import file_name, shown
from .schema import CLASSES, Form, after_loading, before_saving, forms_of

SCHEMA = 1  # raised when a file of today could be misread by the code of tomorrow

_TEXT = "model.json"
_OF_OTHERS = {".mat", ".csv", ".json", ".npy", ".npz", ".pkl", ".h5"}

# Beyond them a text is not one that `save` wrote: an LPV model of 1000 operating points
# has 2 million characters in 100,000 values. They take 100 MB at most to read.
_MOST_TEXT = 2**24
_MOST_VALUES = 500_000

_MOST_MEMBERS = 65_535  # what a zip has without extensions
_LONGEST_RANGE = 1_000  # that becomes a tuple of its numbers
_DEEPEST = 60  # of fields within fields: the deepest of today have 12

_DTYPES = ("<f8", "<i8", "|b1", "<c16")  # of arrays in files

# What NumPy writes in front of an array: magic, version 1.0, length, a literal.
_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|]\w\d+)', 'fortran_order': (True|False), "
    rb"'shape': \(([\d, ]*)\), \} *\n",
    re.DOTALL,
)
_MOST_HEADER = 1000

_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal models make equal files

_NOT_OURS = "`path` must be a whole file that `save` of this library wrote. Got "

Functions = Callable[..., Any] | Mapping[str, Callable[..., Any]] | None


def save(model: Any, path: str | os.PathLike[str]) -> None:
    """Write a model or a fitted estimator to a file without code.

    Parameters
    ----------
    model : object
        A `StateSpace`, `InnovationModel`, `GrayBoxStructure` or `LPVStateSpace`, or an
        estimator of this library, fitted or not.
    path : str or path
        A file there is replaced when the new one is complete on the disk, and stays as
        it was if that fails.

    Raises
    ------
    ValueError
        If the model holds what a file without code cannot: a regressor of another
        library, a `RandomState`, a subclass of the user. If `path` names a folder, a
        device or a pipe.
    OSError
        If the file cannot be written.

    See Also
    --------
    load : Reads it.

    Notes
    -----
    A zip of JSON and ``.npy``, as :ref:`guide_files` describes it field by field.
    Numbers are exact to the bit; an estimator whose `fit` did not end is kept unfitted.
    Not kept are samples: a `SubspaceLTI` goes on to
    tell its uncertainty and its noise model, but not whether a table is the one that it
    was fitted to (`residual_tests` takes every table for a new one), and `partial_fit`
    begins a new stream. Nor is `memory` of a pipeline, a folder on one machine. Of the
    user's functions (`GrayBoxStructure.from_function`, bases that follow the scheduling
    variables) the import path is kept, no code.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from lpvlearn import StateSpace, load, save
    >>> path = Path(tempfile.mkdtemp()) / "lag.zip"
    >>> save(StateSpace(-2, 2, 1), path)
    >>> load(path).poles()
    array([-2.+0.j])
    """
    target = _file(path)
    if target.suffix.lower() in _OF_OTHERS:
        raise ValueError(
            f"`path` must not end in {target.suffix!r}, as files of other programs "
            f"do. Got {str(path)!r}. Use '.lpv', say; for MATLAB export an LPV model "
            "by its to_mat()."
        )
    writer = _Writer()
    if type(before_saving(model)) not in CLASSES.values():
        raise ValueError(
            "`model` must be a StateSpace, InnovationModel, LPVStateSpace, "
            f"GrayBoxStructure, or an estimator of this library. Got {shown(model)}."
        )
    text = {
        "format": "lpvlearn",
        "schema": SCHEMA,
        "lpvlearn": version(),
        "model": writer.node(model, "model"),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        content = json.dumps(text, indent=1, allow_nan=False)
        archive.writestr(zipfile.ZipInfo(_TEXT, _EPOCH), content)
        for name, array in writer.arrays.items():
            with archive.open(zipfile.ZipInfo(name, _EPOCH), "w") as member:
                npy.write_array(member, array, (1, 0), allow_pickle=False)
    try:
        _Reader(_members(buffer.getvalue()), writer.functions).model()
    except ValueError as error:
        raise ValueError(
            f"`model` must be one that `load` can build anew. Got {error}."
        ) from error
    with whole_file(target) as file:
        file.write(buffer.getbuffer())


def load(path: str | os.PathLike[str], *, function: Functions = None) -> Any:
    """Read a model that `save` wrote.

    Parameters
    ----------
    path : str or path
    function : callable or mapping from import path to callable, default=None
        What stands for a user's function in the model: the function, or for several of
        them a function for each import path in the file.

    Returns
    -------
    object
        Of the class that was saved, with equal predictions, scores and reports.

    Raises
    ------
    ValueError
        If the file is not whole, not one of this library, of a later version that this
        one cannot read, or if its parts do not fit together; if a user's function is
        needed and not given.
    OSError
        If the file cannot be read.

    See Also
    --------
    save : Tells what a file does not keep.

    Notes
    -----
    Safe to use on files of strangers: no code comes from a file, and reading one takes
    no more than four times its size in memory and 100 MB.

    Examples
    --------
    A structure that is a function is read where this function is at hand:

    >>> import tempfile
    >>> from pathlib import Path
    >>> from lpvlearn import GrayBoxStructure, load, save
    >>> def decay(theta):
    ...     return [[-1 / theta[0]]], [[1]], [[1]]
    >>> path = Path(tempfile.mkdtemp()) / "decay.zip"
    >>> save(GrayBoxStructure.from_function(decay, initial={"tau": 2.0}), path)
    >>> load(path, function=decay).model([4.0]).A
    array([[-0.25]])
    """
    data = _file(path).read_bytes()
    try:
        members = _members(data)
        del data
        return _Reader(members, function).model()
    except _Told as error:
        raise ValueError(str(error)) from None
    except Exception as error:  # whatever damage may lead to
        raise ValueError(f"{_NOT_OURS}{Path(path).name!r}: {error}") from error


class _Told(Exception):
    """An error of which the message says all."""


def _file(path: Any) -> Path:
    """Where the file is, or will be, that `path` names; links are followed.

    A device or a pipe is refused: it must not be replaced, and may have no end.
    """
    place = Path(os.path.realpath(file_name(path)))
    if os.path.lexists(place) and not place.is_file():
        kind = "a folder" if place.is_dir() else "no regular file"
        raise ValueError(
            f"`path` must name a file, or one to come. Got {str(path)!r}, which is "
            f"{kind}: take another name."
        )
    return place


# -- writing ---------------------------------------------------------------------------


class _Writer:
    """The text of a model, and the arrays that it names."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self.functions: dict[str, Callable[..., Any]] = {}

    def node(self, value: Any, place: str) -> Any:
        """What stands in the text for a value; `place` is where it stands."""
        value = before_saving(value)
        if isinstance(value, np.bool_ | np.integer):
            value = value.item()
        if value is None or isinstance(value, int):
            return None if value is None else _whole(value)
        if isinstance(value, float | np.floating):
            number = float(value)
            return number if math.isfinite(number) else {"float": repr(number)}
        if isinstance(value, str):
            return str(value)
        if isinstance(value, np.ndarray):
            return self._array(value, place)
        if isinstance(value, pd.DataFrame):
            return self._table(value, place)
        if type(value) in CLASSES.values():
            return self._object(value, place)
        if isinstance(value, Mapping):
            pairs = [
                [self.node(k, place), self.node(v, f"{place}.{i}")]
                for i, (k, v) in enumerate(value.items())
            ]
            return {"dict": pairs}
        if isinstance(value, range) and not value[_LONGEST_RANGE:]:
            value = tuple(value)
        if isinstance(value, pd.Index):
            value = value.tolist()
        if isinstance(value, list) and any(isinstance(v, complex) for v in value):
            return self._array(np.array(value), place)
        if type(value) in (list, tuple):
            items = [self.node(v, f"{place}.{i}") for i, v in enumerate(value)]
            return items if isinstance(value, list) else {"tuple": items}
        if callable(value) and hasattr(value, "__qualname__"):
            name = f"{value.__module__}.{value.__qualname__}"
            self.functions[name] = value
            return {"function": name}
        raise ValueError(
            f"`{place}` must be something that a file without code can hold. Got "
            f"{type(value).__module__}.{type(value).__qualname__}. Give numbers, text, "
            "lists, arrays, models of this library, and an integer in the place of a "
            "RandomState; otherwise use pickle, among those you trust."
        )

    def _object(self, value: Any, place: str) -> dict[str, Any]:
        node: dict[str, Any] = {"class": type(value).__name__}
        forms = {name: form for name, form in forms_of(value).items() if form.kept}
        told = [name for name, form in forms.items() if form.fitted and form.needed]
        ended = bool(told) and hasattr(value, told[0])
        missing = [name for name in told if ended and not hasattr(value, name)]
        if missing:
            raise ValueError(
                f"`{place}` must have what its fit tells. Got none of {missing}. Fit "
                "it again."
            )
        for name, form in forms.items():
            if hasattr(value, name) and (ended or not form.fitted):
                field = name.lstrip("_")
                node[field] = self.node(getattr(value, name), f"{place}.{field}")
        return node

    def _array(self, array: NDArray[Any], place: str) -> dict[str, Any]:
        if array.dtype.kind in "OUT" and array.ndim == 1:
            return {"labels": [self.node(v, place) for v in array.tolist()]}
        kinds = {dtype[1]: dtype for dtype in _DTYPES}
        dtype = kinds.get(array.dtype.kind.replace("u", "i"))
        if dtype is None or not np.can_cast(array.dtype, dtype):
            raise ValueError(
                f"`{place}` must be an array of numbers. Got {array.dtype}."
            )
        name = f"{place.removeprefix('model.')}.npy"
        self.arrays[name] = array.astype(dtype, copy=False)
        return {"array": name}

    def _table(self, table: pd.DataFrame, place: str) -> dict[str, Any]:
        index = table.index
        default = isinstance(index, pd.RangeIndex) and index.equals(
            pd.RangeIndex(len(index))
        )
        return {
            "table": [
                self._series(table.iloc[:, k], f"{place}.{k}")
                for k in range(table.shape[1])
            ],
            "index": len(index) if default else self._series(index, f"{place}.index"),
        }

    def _series(self, values: pd.Series | pd.Index, place: str) -> dict[str, Any]:
        dtype = str(values.dtype)
        if dtype not in PLAIN_DTYPES:
            raise ValueError(
                f"`{place}` must hold numbers or text. Got a table of {dtype}."
            )
        numbers = dtype not in ("object", "str")
        return {
            "name": self.node(values.name, place),
            "dtype": dtype,
            "values": self._array(values.to_numpy(), place)
            if numbers
            else [self.node(v, place) for v in values.tolist()],
        }


def _whole(value: int) -> int:
    if isinstance(value, bool) or abs(value) < 2**63:
        return value
    raise ValueError(f"integers of a model must have 64 bits at most. Got {value:.3g}.")


# -- reading ---------------------------------------------------------------------------


def _members(data: bytes) -> dict[str, bytes]:
    """The members of a zip that compresses none of them."""
    if data.count(b"PK\1\2") > _MOST_MEMBERS:
        raise ValueError("more members than a model has")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        listed = archive.infolist()
        for info in listed:
            if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
                raise ValueError(
                    f"{info.filename!r} is compressed or encrypted, as a model never "
                    "is (zip -0 stores)"
                )
        if sum(info.file_size for info in listed) > len(data):
            raise ValueError("its members are larger than the file")
        if len({info.filename for info in listed}) < len(listed):
            raise ValueError("a member is there twice")
        return {info.filename: archive.read(info) for info in listed}


class _Built(NamedTuple):
    """An object, and the sizes that the forms of its fields name."""

    value: Any
    kind: type
    sizes: dict[str, int]


class _Reader:
    """Builds a model from the members of a file."""

    def __init__(self, members: dict[str, bytes], function: Functions) -> None:
        self.members, self.function = members, function

    def model(self) -> Any:
        if _TEXT not in self.members:
            raise ValueError(f"it has no {_TEXT!r}")
        content = self.members.pop(_TEXT)
        values = sum(content.count(c) for c in (b",", b"[", b"{"))
        if len(content) > _MOST_TEXT or values > _MOST_VALUES:
            raise ValueError("its text is longer than that of any model")
        text = json.loads(content.decode(), parse_constant=_refuse_constant)
        if not isinstance(text, dict) or text.get("format") != "lpvlearn":
            raise ValueError("it is no model of lpvlearn")
        schema = text.get("schema")
        if type(schema) is not int or schema < 1:
            raise ValueError(f"schema {schema!r}")
        if schema > SCHEMA:
            raise _Told(
                f"`path` must be a file of schema {SCHEMA} at most. Got {schema}, "
                f"written by lpvlearn {text.get('lpvlearn')}: update the library."
            )
        found = self.value(text.get("model"), Form("object"), "model", {}, 0)
        if self.members:
            raise ValueError(f"no field has the array {next(iter(self.members))!r}")
        return found

    def value(
        self, node: Any, form: Form, place: str, sizes: dict[str, int], depth: int
    ) -> Any:
        """The value of a node, which must be of a form."""
        if depth > _DEEPEST:
            raise ValueError(f"`{place}` lies too deep")
        if isinstance(node, dict) and "class" in node:
            built = self._object(node, place, depth)
            form.agree(built.kind, built.sizes, sizes, place)
            return built.value
        found = self._plain(node, form, place, sizes, depth)
        form.check(found, place, sizes)
        return found

    def _plain(
        self, node: Any, form: Form, place: str, sizes: dict[str, int], depth: int
    ) -> Any:
        inner = form.inner
        if isinstance(node, list):
            return [
                self.value(v, inner, f"{place}.{i}", sizes, depth + 1)
                for i, v in enumerate(node)
            ]
        if not isinstance(node, dict):
            return _whole(node) if isinstance(node, int) else node
        match node:
            case {"array": str(name), **rest} if not rest:
                return self._array(name)
            case {"float": "inf" | "-inf" | "nan" as number, **rest} if not rest:
                return float(number)
            case {"tuple": list(items), **rest} if not rest:
                return tuple(self._plain(items, form, place, sizes, depth))
            case {"labels": list(items), **rest} if not rest:
                return _labels(items, place)
            case {"dict": list(pairs), **rest} if not rest:
                return {
                    _scalar(k, place): self.value(
                        v, inner, f"{place}.{i}", sizes, depth + 1
                    )
                    for i, (k, v) in enumerate(pairs)
                }
            case {"function": str(name), **rest} if not rest:
                return self._function(name, place)
            case {"table": list(columns), "index": index, **rest} if not rest:
                return self._table(columns, index, place)
        raise ValueError(f"`{place}` holds {sorted(node)[:4]}, which is no value")

    def _object(self, node: dict[str, Any], place: str, depth: int) -> _Built:
        kind = CLASSES.get(str(node["class"]))
        if kind is None:
            raise ValueError(f"`{place}` is of an unknown class {node['class']!r}")
        forms = forms_of(kind)
        sizes: dict[str, int] = {}
        known = {name.lstrip("_"): name for name, form in forms.items() if form.kept}
        fields: dict[str, Any] = {}
        fitted = False
        for field, part in node.items():
            if field == "class":
                continue
            name, where = known.get(field), f"{place}.{field}"
            form = Form("any", fitted=True) if name is None else forms[name]
            if name is None:
                name = field
                own = issubclass(kind, BaseEstimator) and field.endswith("_")
                if not own or field.startswith("_") or hasattr(kind, field):
                    raise ValueError(f"a {kind.__name__} has no field `{where}`")
            fields[name] = self.value(part, form, where, sizes, depth + 1)
            fitted |= form.fitted
        for name, form in forms.items():
            needed = form.needed and (fitted or not form.fitted)
            if needed and form.kept and name not in fields:
                raise ValueError(f"`{place}` lacks the field {name.lstrip('_')!r}")
        arguments = inspect.signature(kind).parameters
        try:
            built = kind(**{k: v for k, v in fields.items() if k in arguments})
            if fitted:
                rest = {k: v for k, v in fields.items() if k not in arguments}
                vars(built).update(rest)
            return _Built(after_loading(built), kind, sizes)
        except (ValueError, TypeError, ArithmeticError, LookupError) as error:
            raise ValueError(f"`{place}` fits not together: {error}") from error

    def _array(self, name: str) -> NDArray[Any]:
        if name not in self.members:
            raise ValueError(f"the array {name!r} is missing, or belongs to two fields")
        member = self.members.pop(name)
        found = _HEADER.match(member[:_MOST_HEADER])
        if found is None or found[1].decode() not in _DTYPES:
            raise ValueError(f"{name!r} is no npy file of version 1.0 with numbers")
        dtype, rest = np.dtype(found[1].decode()), memoryview(member)[found.end() :]
        shape = tuple(int(size) for size in re.findall(rb"\d+", found[3]))
        if math.prod(shape) * dtype.itemsize != len(rest):
            raise ValueError(f"{name!r} has not the size of its shape {shape}")
        flat = np.frombuffer(rest, dtype=dtype).copy()
        return flat.reshape(shape, order="F" if found[2] == b"True" else "C")

    def _function(self, name: str, place: str) -> Callable[..., Any]:
        given = self.function
        if isinstance(given, Mapping):
            given = given.get(name)
        if not callable(given):
            raise _Told(
                f"`function` must be the function {name!r} of `{place}`, of which a "
                f"file keeps no code: load(path, function={name.split('.')[-1]}), or "
                f"for several function={{{name!r}: ...}}. Got {given!r}."
            )
        return given

    def _table(self, columns: list[Any], index: Any, place: str) -> pd.DataFrame:
        found = [self._series(column, place) for column in columns]
        if type(index) is int and 0 <= index and (found or not index):
            rows: pd.Index = pd.RangeIndex(index)
        else:
            name, values, dtype = self._series(index, place)
            rows = pd.Index(values, dtype=dtype, name=name, tupleize_cols=False)
        if any(len(values) != len(rows) for _, values, _ in found):
            raise ValueError(f"`{place}` has columns of different lengths")
        series = [pd.Series(v, index=rows, dtype=t) for _, v, t in found]
        table = pd.DataFrame(dict(enumerate(series)), index=rows)
        if found:
            names = [name for name, _, _ in found]
            table.columns = pd.Index(names, tupleize_cols=False)
        return table

    def _series(self, node: Any, place: str) -> tuple[Any, Any, str]:
        match node:
            case {"name": name, "dtype": str(dtype), "values": values, **rest}:
                if not rest and dtype in PLAIN_DTYPES:
                    name = _scalar(name, place)
                    if isinstance(values, list):
                        return name, _labels(values, place), dtype
                    form = Form(f"{dtype.rstrip('64')}[n_rows]")
                    return name, self.value(values, form, place, {}, 0), dtype
        raise ValueError(f"`{place}` is no table")


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _labels(items: list[Any], place: str) -> NDArray[Any]:
    found = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):  # a tuple is one of them
        found[i] = _scalar(item, place)
    return found


def _scalar(node: Any, place: str) -> Any:
    """A label: None, a number, text, or a tuple of them."""
    match node:
        case {"float": "inf" | "-inf" | "nan" as number, **rest} if not rest:
            return float(number)
        case {"tuple": list(items), **rest} if not rest:
            return tuple(_scalar(item, place) for item in items)
        case None | bool() | int() | float() | str():
            return _whole(node) if isinstance(node, int) else node
    raise ValueError(f"`{place}` has a label that is none")
