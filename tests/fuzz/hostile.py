"""Values that a caller may give by mistake, or by malice."""

import tempfile
import warnings
from datetime import UTC, datetime
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from scipy import sparse

NUMBERS = (
    *(0, 1, -1, 2, 3, 7, 0.5, -0.5, 1e-3, -0.0, 5e-324, 1e-300, 1e16, 1e308, -1e308),
    *(np.nan, np.inf, -np.inf, 10**6, 2**31, 2**63, 10**400, -(10**400)),
)

SCALARS = (
    *(
        None,
        True,
        False,
        "",
        "text",
        "nan",
        "1.0",
        "µ",
        "$x_",
        "auto",
        b"bytes",
        1 + 2j,
    ),
    *(Decimal("0.5"), Decimal("sNaN"), Fraction(1, 3), ..., object(), type, len),
    *(pd.NA, pd.NaT, pd.Timestamp(0), pd.Timedelta(1, "s"), datetime.now(UTC)),
    *(
        np.float16(1),
        np.float32(0.1),
        np.longdouble(2),
        np.int8(1),
        np.uint64(2**64 - 1),
    ),
    *(np.bool_(True), np.str_("x"), np.bytes_(b"x"), np.complex64(1j)),
    *(np.datetime64("2020-01-01"), np.datetime64("NaT", "s"), np.timedelta64(1, "s")),
)

CONTAINERS = (
    *([], (), {}, set(), [[]], [[[]]], {"a": 1}, {1, 2}, [None], [[None, 1]], ["a"]),
    *(
        [[1], [1, 2]],
        [{}],
        [b"1"],
        [1j],
        range(3),
        [0, 1],
        [[1, 2], [3, 4]],
        [0.1, 0.2],
    ),
    *(slice(None), iter([1, 2]), [10**400], [[object()]], {"k": "v"}, [True, False]),
    np.array(3.0),
    np.array([]),
    np.zeros((0, 2)),
    np.zeros((2, 0)),
    np.zeros((2, 2, 2)),
    np.array([None, 1.0], object),
    np.array([{}, {}], object),
    np.array([1 + 1j, 2], object),
    np.array(["1", "2"]),
    np.array([b"1"]),
    np.array(["2020-01-01"], "M8[s]"),
    np.array([(1, 2.0)], dtype=[("a", int), ("b", float)]),
    np.ma.masked_invalid([1.0, np.nan]),
    np.eye(2).view(np.matrix),
    sparse.csr_matrix(np.eye(3)),
    pd.DataFrame(),
    pd.Series([1, None], dtype="Int64"),
    pd.Series(["a", "b"], dtype="category"),
    pd.Index([1.0, 2.0]),
)

VALUES = (*NUMBERS, *SCALARS, *CONTAINERS)
ANY = st.sampled_from(VALUES)

# Options of one function or another: valid ones lead to other code.
WORDS = (
    *("auto", "all", "local", "default", "rest", "estimate", "raise", "split", "skip"),
    *("n4sid", "cva", "pi-moesp", "po-moesp", "pbsid", "simulation", "prediction"),
    *("warn", "enforce", "constant", "linear", "pool", "average", "zoh", "foh"),
    *("tustin",),
    *("hinf", "linf", "h2", "covariance", "similarity", "random", "sqp", "bundle"),
    *("power", "chebyshev", "legendre", "total", "tensor", "pchip", "cubic", "aic"),
    *("bic", "clip", "error", "ignore", "raw_values", "uniform_average", "pandas"),
    *("variance_weighted", "passthrough", "held_out", "experiment", "uncertainty"),
    *("neighbour_gap", "operating_point", "position", "velocity", "acceleration"),
    *("momentum", "rate", "flux", "input", "output", "force", "kappa", "run", "time"),
)

SPECIAL = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e-320, 5e-324, 0.0, 1e16)

DTYPES = (
    *("float16", "float32", "longdouble", "int8", "int64", "uint8", "bool", "object"),
    *("complex128", "str", "S5", "M8[ns]", "m8[s]", ">f8"),
)

EXTENSIONS = (
    *("Float64", "Int64", "Float32", "boolean", "string", "category", "object"),
    *("datetime64[ns]", "timedelta64[ns]", "Sparse[float]", "float16", "complex128"),
    "double[pyarrow]",
)


@st.composite
def hostile_array(draw, array):
    """A valid array with one thing changed."""
    change = draw(st.sampled_from(sorted(CHANGES)))
    return _or_as_it_is(CHANGES[change], draw, array.copy())


def _or_as_it_is(change, draw, value):
    """The changed value; where numpy or pandas know no such change, the value."""
    try:
        with warnings.catch_warnings():  # what they warn of is what is wanted
            warnings.simplefilter("ignore")
            return change(draw, value)
    except (
        TypeError,
        ValueError,
        ArithmeticError,
        LookupError,
        NotImplementedError,
        AttributeError,
        ImportError,
    ):
        return value


def _put(draw, array):
    if array.dtype.kind == "O":
        value = draw(ANY)
    else:
        array, value = array.astype(float), draw(st.sampled_from(SPECIAL))
    array.flat[draw(st.integers(0, max(array.size - 1, 0)))] = value
    return array


def _fill(draw, array):
    return np.full(array.shape, draw(st.sampled_from(SPECIAL)))


def _scale(draw, array):
    with np.errstate(over="ignore"):
        return array * draw(st.sampled_from((1e-200, 1e-12, -1.0, 1e12, 1e200)))


def _memory_mapped(draw, array):
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "a.npy", array)
        return np.load(Path(folder) / "a.npy", mmap_mode="r")


def _read_only(draw, array):
    array.setflags(write=False)
    return array


CHANGES = {
    "a special value": _put,
    "special values": _fill,
    "another scale": _scale,
    "another dtype": lambda draw, a: a.astype(draw(st.sampled_from(DTYPES))),
    "no rows": lambda draw, a: a[:0],
    "one row": lambda draw, a: a[:1],
    "two rows": lambda draw, a: a[:2],
    "a row less": lambda draw, a: a[:-1],
    "rows twice": lambda draw, a: np.concatenate([a, a]),
    "no columns": lambda draw, a: a[..., :0],
    "columns twice": lambda draw, a: np.concatenate([a, a], axis=-1),
    "flat": lambda draw, a: a.ravel(),
    "an axis more": lambda draw, a: a[None],
    "a column": lambda draw, a: a.reshape(-1, 1),
    "transposed": lambda draw, a: a.T,
    "backwards": lambda draw, a: a[::-1],
    "sorted": lambda draw, a: np.sort(a, axis=0),
    "a number": lambda draw, a: a.ravel()[0],
    "a list": lambda draw, a: a.tolist(),
    "a table": lambda draw, a: pd.DataFrame(a),
    "a series": lambda draw, a: pd.Series(a.ravel()),
    "a nullable table": lambda draw, a: pd.DataFrame(a).convert_dtypes(),
    "Fortran's order": lambda draw, a: np.asfortranarray(a),
    "a masked array": lambda draw, a: np.ma.masked_less(a, 0.0),
    "a sparse matrix": lambda draw, a: sparse.csr_matrix(a),
    "a memory map": _memory_mapped,
    "read-only": _read_only,
}


@st.composite
def hostile_table(draw, table):
    """A valid table with one or two things changed."""
    for _ in range(draw(st.integers(1, 2))):
        change = draw(st.sampled_from(sorted(TABLE_CHANGES)))
        table = _or_as_it_is(TABLE_CHANGES[change], draw, table)
        if not isinstance(table, pd.DataFrame):
            break
    return table


def _column(draw, table):
    return draw(st.sampled_from(list(table.columns)))


def _put_in_table(draw, table):
    column = _column(draw, table)
    value = draw(st.sampled_from((*SPECIAL, None, pd.NA, "x", 1j, 10**400)))
    values = table[column].astype(object).tolist()
    values[draw(st.integers(0, len(values) - 1))] = value
    return table.assign(**{column: values})


def _retyped(draw, table):
    column = _column(draw, table)
    return table.astype({column: draw(st.sampled_from(EXTENSIONS))})


def _renamed(draw, table):
    column = _column(draw, table)
    name = draw(st.sampled_from(("", "$x_{", 0, None, "µ", "a\nb", ("a", 1), "kappa")))
    return table.rename(columns={column: name})


def _indexed(draw, table):
    n = len(table)
    index = {
        "duplicated": np.zeros(n, int),
        "backwards": np.arange(n)[::-1],
        "labels": [f"r{i}" for i in range(n)],
        "times": pd.date_range("2020-01-01", periods=n, freq="s"),
        "levels": pd.MultiIndex.from_arrays([np.arange(n) % 2, np.arange(n)]),
        "missing": [np.nan] * n,
    }
    return table.set_axis(index[draw(st.sampled_from(sorted(index)))], axis=0)


def _special_column(draw, table):
    value = draw(st.sampled_from(SPECIAL))
    return table.assign(**{_column(draw, table): value})


def _scaled_column(draw, table):
    column = _column(draw, table)
    with np.errstate(over="ignore"):
        return table.assign(**{column: _scale(draw, table[column].to_numpy())})


TABLE_CHANGES = {
    "a special value": _put_in_table,
    "special values": _special_column,
    "another scale": _scaled_column,
    "another dtype": _retyped,
    "another name": _renamed,
    "another index": _indexed,
    "a column less": lambda draw, t: t.drop(columns=_column(draw, t)),
    "a column twice": lambda draw, t: pd.concat([t, t[[_column(draw, t)]]], axis=1),
    "a column more": lambda draw, t: t.assign(more=np.arange(len(t))),
    "no rows": lambda draw, t: t.iloc[:0],
    "few rows": lambda draw, t: t.iloc[: draw(st.integers(1, 5))],
    "a row less": lambda draw, t: t.iloc[:-1],
    "rows of one kind": lambda draw, t: t.iloc[: len(t) // 3],
    "a gap": lambda draw, t: t.drop(index=t.index[7:9]),
    "rows twice": lambda draw, t: pd.concat([t, t]),
    "shuffled": lambda draw, t: t.sample(frac=1.0, random_state=0),
    "backwards": lambda draw, t: t.iloc[::-1],
    "an array": lambda draw, t: t.to_numpy(),
    "columns backwards": lambda draw, t: t.iloc[:, ::-1],
    "a list": lambda draw, t: t.to_numpy().tolist(),
    "a series": lambda draw, t: t.iloc[:, 0],
    "a dictionary": lambda draw, t: t.to_dict("list"),
    "levels of columns": lambda draw, t: t.set_axis(
        pd.MultiIndex.from_product([["a"], t.columns]), axis=1
    ),
    "an index of the columns": lambda draw, t: t.set_index(_column(draw, t)),
}


def hostile(value):
    """What may stand in the place of a valid value, of its own kind more often."""
    if isinstance(value, pd.DataFrame):
        return st.one_of(hostile_table(value), hostile_table(value), ANY)
    if isinstance(value, np.ndarray | list) and not isinstance(value[0], tuple):
        array = np.asarray(value, None if hasattr(value, "dtype") else object)
        return st.one_of(hostile_array(array), hostile_array(array), ANY)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return st.one_of(st.sampled_from(NUMBERS), ANY)
    if isinstance(value, str):
        return st.one_of(st.sampled_from(WORDS), ANY)
    return ANY


@st.composite
def spoiled(draw, arguments):
    """What a caller gave in the place of one or two of the valid `arguments`."""
    names = st.sampled_from(sorted(arguments))
    some = draw(st.lists(names, min_size=1, max_size=2, unique=True))
    return {name: draw(hostile(arguments[name])) for name in some}
