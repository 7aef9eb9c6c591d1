"""What every room checks of its arguments, once: a value, or an error that names it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from importlib import import_module
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SHOWN = 80  # characters of a value in a message, lest a table fills the screen
_SHORT = 8  # characters of a number that is shown as it was written
_OF_WIDTH = 3  # digits of a range that a number of it shows

SQUARED = 1e150  # numbers below it have squares that are numbers

_LONGEST = 1e100  # seconds: times of samples, and what divides by them, are numbers

_LATEST = 1e9  # samples of an input's delay: more are no record's


def real_array(name: str, value: Any) -> Array:
    """`value` as a new array of floats, or a ValueError that names the argument.

    This is the door for numbers: text that looks like them, dates, complex numbers and
    integers beyond floats are refused, as converting them silently hides a mistake.
    What is missing (None or NA in an array, masked) becomes NaN.
    """
    return _numbers(name, value, np.dtype(np.float64), "real")


def complex_array(name: str, value: Any) -> NDArray[np.complex128]:
    """`value` as a new array of complex numbers, see `real_array`."""
    return _numbers(name, value, np.dtype(np.complex128), "real or complex")


def _numbers(name: str, value: Any, dtype: np.dtype[Any], kinds: str) -> NDArray[Any]:
    try:
        if type(value) is np.ndarray and value.dtype == dtype:
            return value.copy()
        array = np.asarray(value)
        fits = array.dtype.kind in ("biufc" if dtype.kind == "c" else "biuf")
        if array.dtype.kind == "O" and array.ndim:
            fits = all(_is_number(x) or x is None or x is pd.NA for x in array.flat)
            array = np.where(pd.isna(array), np.nan, array)
        elif array.dtype.kind == "O":
            fits = _is_number(array.item())
        if fits:
            with np.errstate(over="ignore"):  # infinity is told where it may not be
                found = np.array(array, dtype)
            if np.ma.isMaskedArray(value):
                found[np.ma.getmaskarray(value)] = np.nan
            return found
    except (TypeError, ValueError, ArithmeticError):
        pass
    raise ValueError(f"`{name}` must hold {kinds} numbers only. Got {shown(value)}.")


def _is_number(value: Any) -> bool:
    """Whether one value is a real number; a time difference is none, whatever NumPy
    calls it."""
    real = isinstance(value, Real | Decimal | np.bool_)
    return real and not isinstance(value, np.timedelta64)


def first_not_a_number(values: Iterable[Any]) -> int | None:
    """Place of the first value that is neither a real number nor missing."""
    for row, value in enumerate(values):
        try:
            float("j" if np.iscomplexobj(value) else value)
        except (TypeError, ValueError, ArithmeticError):
            if value is not pd.NA and value is not None:
                return row
    return None


def number(
    name: str,
    value: Any,
    rule: str = "a finite number",
    *,
    above: float = -np.inf,
    low: float = -np.inf,
    high: float = np.inf,
) -> float:
    """`value` as a finite float greater than `above` and from `low` to `high`.

    Else a ValueError that names it and says the `rule`.
    """
    found = np.nan
    if not isinstance(value, bool | np.bool_):
        try:
            array = real_array(name, value)
            found = float(array) if array.ndim == 0 else np.nan
        except ValueError:
            pass
    if not (np.isfinite(found) and above < found and low <= found <= high):
        raise ValueError(f"`{name}` must be {rule}. Got {shown(value)}.")
    return found


def share(name: str, value: Any) -> float:
    """`value` as a float between 0 and 1, neither of them."""
    below = float(np.nextafter(1.0, 0.0))
    return number(name, value, "between 0 and 1", above=0.0, high=below)


def flag(name: str, value: Any) -> bool:
    """`value` as True or False, or a ValueError that names it."""
    if isinstance(value, Integral | np.bool_) and value in (0, 1):
        return bool(value)
    raise ValueError(f"`{name}` must be True or False. Got {shown(value)}.")


@contextmanager
def naming_argument(name: str, rule: str, value: Any) -> Iterator[None]:
    """Tell the argument, its rule and the value where another library refuses it."""
    try:
        yield
    except (TypeError, ValueError, ArithmeticError) as error:
        if f"`{name}`" in str(error):
            raise
        kind = ValueError if isinstance(error, ArithmeticError) else type(error)
        raise kind(f"`{name}` must {rule}. Got {shown(value)}: {error}") from error


def listed(texts: Sequence[str], most: int) -> str:
    """The first of some texts, and how many there are beside them.

    >>> listed(["a", "b", "c"], 2)
    'a, b and 1 more'
    """
    rest = len(texts) - most
    return ", ".join(texts[:most]) + (f" and {rest} more" if rest > 0 else "")


def shown(value: Any) -> str:
    """A value in a message, of which a table shows its beginning only."""
    try:
        text = repr(value)
    except Exception:  # of a foreign object, or an integer of too many digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def number_shown(value: float, width: float = 0.0) -> str:
    """A number that labels something, as it was written where that is short.

    Of a range of that `width`, to a thousandth of it.

    >>> [number_shown(value) for value in (101310.0, 293.15, 0.1 + 0.2, np.pi / 4)]
    ['101310', '293.15', '0.3', '0.7854']
    >>> number_shown(101312.3456, width=30.0)
    '101312.35'
    """
    if 0.0 < width < math.inf:
        value = round(float(value), _OF_WIDTH - math.floor(math.log10(width)))
        return f"{value + 0.0:.12g}"
    text = f"{value + 0.0:.12g}"
    whole = text.removeprefix("-").isdigit()
    return text if len(text) <= _SHORT or whole else f"{value:.4g}"


def squarable(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """The array, whose finite values must have squares that are numbers."""
    huge = array[np.isfinite(array) & ~(np.abs(array) < SQUARED)]
    if len(huge):
        raise ValueError(
            f"`{name}` must hold numbers below {SQUARED:g}, as they are squared. Got "
            f"{huge[0]}; take another unit."
        )
    return array


def matrix(name: str, value: ArrayLike) -> Array:
    """`value` as a new matrix of numbers with squares; one row may stand for it."""
    array = real_array(name, value)
    if array.ndim == 2 and np.abs(array).max(initial=0.0) < SQUARED:
        return array
    if array.ndim < 2:
        array = array.reshape(1, -1) if array.size else np.zeros((0, 0))
    if array.ndim != 2:
        raise ValueError(f"`{name}` must have 2 dimensions. Got shape {array.shape}.")
    return squarable(name, all_finite(name, array, "[{}, {}]"))


def all_finite(name: str, array: Array, place: str) -> Array:
    """The array, or a ValueError that tells what stands at which `place`."""
    finite = np.isfinite(array)
    if not finite.all():
        at = tuple(np.argwhere(~finite)[0])
        where = place.format(*at)
        raise ValueError(f"`{name}` must be finite. Got {array[at]} at {where}.")
    return array


def file_name(value: Any, argument: str = "path", kind: str = "file") -> Path:
    """The absolute path that a user names a file or folder by, or a ValueError."""
    name = os.fspath(value) if isinstance(value, str | os.PathLike) else ""
    if not isinstance(name, str) or not name or "\0" in name:
        raise ValueError(f"`{argument}` must name a {kind}. Got {shown(value)}.")
    return Path(name).absolute()


def weights(value: Any, n: int, of: str = "row") -> Array:
    """`sample_weight` as a vector of `n` weights, or a ValueError."""
    found = real_array("sample_weight", value)
    good = found.shape == (n,) and (found >= 0.0).all() and (found < SQUARED).all()
    if not good or not (found > 1.0 / SQUARED).any():
        raise ValueError(
            f"`sample_weight` must hold {n} weights, one for each {of}: below "
            f"{SQUARED:g}, not negative and not all zero, as what lies below "
            f"{1.0 / SQUARED:g} is when squared. Got {shown(value)}."
        )
    return found


def verbosity(value: Any) -> None:
    """Refuse a `verbose` that is neither a boolean nor an integer of at least 0."""
    if not isinstance(value, bool):
        whole_number("verbose", value, 0)


def positive_time(name: str, value: Any) -> float:
    """`value` as a positive finite float, or a ValueError that names it."""
    rule = f"a positive number of seconds, {1 / _LONGEST:g} to {_LONGEST:g}"
    return number(name, value, rule, low=1 / _LONGEST, high=_LONGEST)


def is_whole(value: Any) -> bool:
    """Whether a value is an integer: no bool, and no time, whatever NumPy calls it."""
    return isinstance(value, Integral) and not isinstance(value, bool | np.timedelta64)


def whole_number(name: str, value: Any, low: int, high: int | None = None) -> int:
    """`value` as an int from `low` to `high`, or a ValueError that names it."""
    if not is_whole(value) or value < low or (high is not None and value > high):
        limits = f"at least {low}" if high is None else f"{low} to {high}"
        raise ValueError(f"`{name}` must be an integer, {limits}. Got {shown(value)}.")
    return int(value)


def one_of(name: str, value: Any, allowed: Sequence[Any]) -> None:
    """Refuse a `value` that is none of the `allowed` options, naming them.

    Examples
    --------
    >>> one_of("norm", "h3", ("hinf", "h2"))
    Traceback (most recent call last):
        ...
    ValueError: `norm` must be 'hinf' or 'h2'. Got 'h3'.
    """
    if any(value is v or (isinstance(value, str) and value == v) for v in allowed):
        return
    listed = [repr(option) for option in allowed]
    last = f"{', '.join(listed[:-1])} or " if len(listed) > 1 else ""
    raise ValueError(f"`{name}` must be {last}{listed[-1]}. Got {shown(value)}.")


def frequencies(omega: ArrayLike) -> Array:
    """`omega`, (n_freq,) or a number, as a vector without NaN; it may hold infinity."""
    omega = np.atleast_1d(real_array("omega", omega))
    if omega.ndim != 1 or np.isnan(omega).any():
        raise ValueError(
            "`omega` must have shape (n_freq,) and hold no NaN. Got "
            f"shape {omega.shape} with {np.isnan(omega).sum()} NaN."
        )
    return squarable("omega", omega)


def place(name: str, value: Any, n: int) -> Array:
    """`value` as a finite vector of `n` values; a number may stand for one."""
    found = real_array(name, value).reshape(-1)
    if found.shape != (n,) or not np.isfinite(found).all():
        raise ValueError(
            f"`{name}` must be one finite value of every scheduling variable, {n}. Got "
            f"{shown(value)}."
        )
    return found


def finite_samples(name: str, value: ArrayLike, width: int) -> Array:
    """Inputs `u` or outputs `y` as a finite array of shape (n_samples, width)."""
    array = real_array(name, value)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(
            f"`{name}` must have shape (n_samples, {width}). Got {array.shape}."
        )
    channel = "input" if name == "u" else "output"
    return all_finite(name, array, f"sample {{}}, {channel} {{}}")


def measured_samples(y: ArrayLike, n_samples: int, width: int) -> Array:
    """Outputs `y` of the samples of `u`, (n_samples, width); NaN where missing."""
    measured = squarable("y", real_array("y", y))
    missing = np.isnan(measured)
    y = finite_samples("y", np.where(missing, 0.0, measured), width)
    if n_samples == 0 or n_samples != len(y):
        raise ValueError(
            "`u` and `y` must have one row for each of the same samples, at least one. "
            f"Got {n_samples} and {len(y)}."
        )
    y[missing.reshape(y.shape)] = np.nan
    return y


def state_vector(x0: ArrayLike, order: int, n_more: int = 0) -> Array:
    """`x0` as a finite array of shape (order + n_more,), or a ValueError that names it.

    The entries after the first `order` may be left out: they are zero then.
    """
    x0 = real_array("initial_state", x0).reshape(-1)
    if x0.shape not in ((order,), (order + n_more,)):
        more = f", or with the inputs in transit ({order + n_more},)" if n_more else ""
        raise ValueError(
            f"`initial_state` must have shape ({order},){more}. Got {x0.shape}."
        )
    if not np.isfinite(x0).all():
        raise ValueError(f"`initial_state` must be finite. Got {x0}.")
    return np.concatenate([x0, np.zeros(order + n_more - len(x0))])


def input_delays(value: ArrayLike, n_inputs: int, *, samples: bool) -> NDArray[Any]:
    """`value` as a read-only delay of every input: whole samples, else seconds.

    One number is the delay of all inputs. A ValueError where it is no delay.
    """
    delay = real_array("input_delay", value)
    shape_fits = delay.shape in ((), (n_inputs,))
    if shape_fits and np.isfinite(delay).all() and (delay >= 0).all():
        delay = np.broadcast_to(delay, (n_inputs,)).copy()
        if samples and (delay == np.floor(delay)).all() and (delay <= _LATEST).all():
            delay = delay.astype(np.intp)
        if not samples or delay.dtype == np.intp:
            delay.setflags(write=False)
            return delay
    unit = "a whole number of samples" if samples else "a number of seconds"
    raise ValueError(
        f"`input_delay` must be {unit}, 0 or more, for all inputs or one for each of "
        f"the {n_inputs}. Got {shown(value)}."
    )


def has_one_axis(value: Any) -> bool:
    """Whether a value is a list, or an array like one."""
    try:
        return np.ndim(value) == 1
    except ValueError:  # rows of several lengths
        return False


def names_of(
    argument: str, names: Any, n: int | None = None, *, of_columns: bool = False
) -> list[Any]:
    """`names` as a list of different ones, `n` of them or any number above zero.

    One of columns may be a tuple, as those of a MultiIndex are.
    """
    listed: list[Any] = []
    several = of_columns and isinstance(names, list | tuple)
    if several or (has_one_axis(names) and not isinstance(names, Mapping)):
        listed = list(names)
    try:
        distinct = len({*listed}) == len(listed)
    except TypeError:  # a list or a table, which is no name
        distinct = False
    if not listed or not distinct or n not in (None, len(listed)):
        many = "" if n is None else f"{n} "
        raise ValueError(
            f"`{argument}` must be a list of {many}distinct names. Got {shown(names)}."
        )
    return listed


def optional_module(name: str, asked_by: str, package: str) -> Any:
    """A module of a package that only some need, or an ImportError that says which."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"`{asked_by}` needs the package {package}. Install it: pip install "
            f"{package}."
        ) from error


def units_by_name(units: Any) -> dict[str, str] | None:
    """The argument `units`, a mapping from names to text, as a dict; None stays."""
    if units is None:
        return None
    if not isinstance(units, Mapping) or not all(
        isinstance(unit, str) for unit in units.values()
    ):
        raise ValueError(
            "`units` must be a dict from names to units, such as {'angle': 'rad'}. Got "
            f"{shown(units)}."
        )
    return {str(name): unit for name, unit in units.items()}


def named_values(
    argument: str,
    values: ArrayLike | Mapping[str, float],
    names: Sequence[str] | None,
) -> tuple[Array, list[str]]:
    """Finite values of parameters, and their names (p1, p2, ... if not given)."""
    if isinstance(values, Mapping):
        names = names_of("parameter_names", list(values) if names is None else names)
        if set(names) != set(values):
            raise ValueError(
                f"`{argument}` must have a value for each of {names}. Got values for "
                f"{list(values)}."
            )
        values = [values[name] for name in names]
    start = np.atleast_1d(real_array(argument, values))
    if names is None:
        names = [f"p{i + 1}" for i in range(start.size)]
    names = names_of("parameter_names", names)
    if start.shape != (len(names),) or not np.isfinite(start).all():
        raise ValueError(
            f"`{argument}` must hold one finite value for each of the {len(names)} "
            f"parameters. Got {start}."
        )
    return start, names
