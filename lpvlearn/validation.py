"""What every room checks of its arguments, once: a value, or an error that names it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def real_array(name: str, value: Any) -> Array:
    """`value` as a new array of floats, or a ValueError that names the argument.

    Strings that look like numbers and complex numbers are refused: converting them
    silently hides a mistake.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biufO":
            return np.array(array, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"`{name}` must hold real numbers only. Got {shown(value)}.")


def shown(value: Any) -> str:
    """A value in a message, of which a table shows its beginning only."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def matrix(name: str, value: ArrayLike) -> Array:
    """`value` as a new finite matrix; a number or one row may stand for it."""
    array = real_array(name, value)
    if array.ndim < 2:
        array = array.reshape(1, -1) if array.size else np.zeros((0, 0))
    if array.ndim != 2:
        raise ValueError(f"`{name}` must have 2 dimensions. Got shape {array.shape}.")
    return _finite(name, array, "[{}, {}]")


def _finite(name: str, array: Array, place: str) -> Array:
    finite = np.isfinite(array)
    if not finite.all():
        at = tuple(np.argwhere(~finite)[0])
        where = place.format(*at)
        raise ValueError(f"`{name}` must be finite. Got {array[at]} at {where}.")
    return array


def positive_time(name: str, value: Any) -> float:
    """`value` as a positive finite float, or a ValueError that names it."""
    try:
        time = np.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        time = np.nan
    if not 0.0 < time < np.inf:
        raise ValueError(
            f"`{name}` must be a positive number of seconds. Got {shown(value)}."
        )
    return time


def whole_number(name: str, value: Any, low: int, high: int | None = None) -> int:
    """`value` as an int from `low` to `high`, or a ValueError that names it."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value < low or (high is not None and value > high):
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
    return omega


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
    return _finite(name, array, f"sample {{}}, {channel} {{}}")


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
        if samples and (delay == np.floor(delay)).all():
            delay = delay.astype(np.intp)
        if not samples or delay.dtype == np.intp:
            delay.setflags(write=False)
            return delay
    unit = "a whole number of samples" if samples else "a number of seconds"
    raise ValueError(
        f"`input_delay` must be {unit}, 0 or more, for all inputs or one for each of "
        f"the {n_inputs}. Got {value!r}."
    )


def named_values(
    argument: str,
    values: ArrayLike | Mapping[str, float],
    names: Sequence[str] | None,
) -> tuple[Array, list[str]]:
    """Finite values of parameters, and their names (p1, p2, ... if not given)."""
    if isinstance(values, Mapping):
        names = list(values) if names is None else list(names)
        if set(names) != set(values):
            raise ValueError(
                f"`{argument}` must have a value for each of {names}. Got values for "
                f"{list(values)}."
            )
        values = [values[name] for name in names]
    start = np.atleast_1d(real_array(argument, values))
    names = [f"p{i + 1}" for i in range(len(start))] if names is None else list(names)
    if not names or len(set(names)) != len(names):
        raise ValueError(f"`parameter_names` must be distinct names. Got {names}.")
    if start.shape != (len(names),) or not np.isfinite(start).all():
        raise ValueError(
            f"`{argument}` must hold one finite value for each of the {len(names)} "
            f"parameters. Got {start}."
        )
    return start, names
