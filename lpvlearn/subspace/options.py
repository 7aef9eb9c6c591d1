"""Options of `SubspaceLTI`: what is allowed, and what the user is told."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.preparation import DETRENDS, Pairs
from ..exceptions import RankWarning
from ..validation import positive_time
from .identification import Identified, max_horizon, max_order
from .realization import METHODS
from .selection import Candidate, Selection

Array = NDArray[np.float64]


def check_size(
    pairs: Pairs, order: int | None, horizon: int | None, method: str
) -> None:
    """Refuse a horizon or an order that the number of samples cannot carry.

    Parameters
    ----------
    pairs : list of (u, y)
    order, horizon : int or None
        None is still to be chosen.
    method : str
        As in `SubspaceLTI`.

    Raises
    ------
    ValueError
    """
    lengths = [len(u) for u, _ in pairs]
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    longest = max_horizon(lengths, n_inputs, n_outputs)
    if horizon is not None and horizon > longest:
        raise ValueError(
            f"`horizon` must be at most {longest} for {sum(lengths)} samples of "
            f"{n_inputs} input(s) and {n_outputs} output(s). Got {horizon}. Use "
            "horizon='auto' or more samples."
        )
    used = longest if horizon is None else horizon
    highest = max_order(used, n_inputs, n_outputs, method)
    if order is not None and order > highest:
        raise ValueError(
            f"`order` must be at most {highest} for {sum(lengths)} samples and horizon "
            f"{used}. Got {order}."
        )


# A model that explains less than this share of the outputs' size is reported.
_USELESS_FIT = 0.1

# A stream that fits worse than its first samples by this factor, and by more than this
# share of the outputs' size.
_MUCH_WORSE = 5.0

_POOR_FIT = 0.2

# Enforced stability that takes the model more than this share of the outputs' energy.
_HALF = 0.5

# An integrator's pole may lie this far outside the unit circle by rounding.
_ROUNDING = 1e-8


class Choices(NamedTuple):
    """Checked options.

    Attributes
    ----------
    order, horizon : int or None
        None is to be chosen.
    n_noise_states : int
        Additional states of the subspace step.
    """

    order: int | None
    horizon: int | None
    n_noise_states: int


def check_options(estimator: Any) -> Choices:
    """Refuse what is not an option, naming those that are.

    Parameters
    ----------
    estimator : SubspaceLTI

    Returns
    -------
    Choices

    Raises
    ------
    ValueError
    """
    allowed = {
        "method": METHODS,
        "stability": ("warn", "enforce"),
        "initial_state": ("estimate", "rest"),
        "missing": ("raise", "split"),
        "detrend": DETRENDS,
    }
    for name, values in allowed.items():
        value = getattr(estimator, name)
        if not any(value is v or (isinstance(v, str) and value == v) for v in values):
            listed = " or ".join(repr(v) for v in values)
            if len(values) > 3:
                listed = "one of " + ", ".join(str(v) for v in values)
            raise ValueError(f"`{name}` must be {listed}. Got {value!r}.")
    if estimator.sampling_time is not None:
        positive_time("sampling_time", estimator.sampling_time)
    if estimator.initial_state == "rest" and estimator.missing == "split":
        raise ValueError(
            "`initial_state` must be 'estimate' with missing='split': what follows a "
            "gap does not start from rest. Got 'rest'."
        )
    order = _integer_or_auto("order", estimator.order, 0)
    horizon = _integer_or_auto("horizon", estimator.horizon, 1)
    noise = _integer_or_auto("n_noise_states", estimator.n_noise_states, 0)
    return Choices(order, horizon, noise or 0)


def _integer_or_auto(name: str, value: Any, lowest: int) -> int | None:
    if isinstance(value, str) and value == "auto":
        return None
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_integer or value < lowest:
        raise ValueError(
            f"`{name}` must be 'auto' or an integer of at least {lowest}. "
            f"Got {value!r}."
        )
    return int(value)


def feedthrough_mask(
    feedthrough: Any, n_outputs: int, n_inputs: int, basis: Array
) -> NDArray[np.bool_]:
    """Free entries of D for the (independent) inputs.

    Parameters
    ----------
    feedthrough : bool or array-like of bool, shape (n_outputs, n_inputs)
    n_outputs, n_inputs : int
    basis : ndarray of shape (n_inputs, rank)
        From `reduce_inputs`.

    Returns
    -------
    ndarray of bool, shape (n_outputs, rank)

    Raises
    ------
    ValueError
        If the shape does not fit, or zeros are asked for of collinear inputs.
    """
    mask = np.asarray(feedthrough)
    if mask.ndim == 0:
        return np.full((n_outputs, basis.shape[1]), bool(feedthrough))
    if mask.shape != (n_outputs, n_inputs):
        raise ValueError(
            "`feedthrough` must be True, False or a table of shape (n_outputs, "
            f"n_inputs) = ({n_outputs}, {n_inputs}). Got shape {mask.shape}."
        )
    mask = mask.astype(bool)
    if basis.shape[0] == basis.shape[1] or mask.all() or not mask.any():
        return mask if basis.shape[0] == basis.shape[1] else mask[:, : basis.shape[1]]
    raise ValueError(
        "`feedthrough` cannot fix single entries of D while inputs are collinear. "
        "Leave all but one of the collinear inputs out."
    )


def selection_table(selection: Selection) -> pd.DataFrame:
    """Everything that was tried, one row per candidate."""
    order, horizon, criterion, bft = (
        np.array(c) for c in zip(*selection.candidates, strict=True)
    )
    chosen = (order == selection.order) & (horizon == selection.horizon)
    columns = (order, horizon, criterion, bft, chosen)
    names = (*Candidate._fields, "chosen")
    return pd.DataFrame(dict(zip(names, columns, strict=True)))


def selection_text(table: pd.DataFrame) -> str:
    """The selection table as text, the chosen row marked.

    Examples
    --------
    >>> import pandas as pd
    >>> row = {"order": 2, "horizon": 9, "criterion": 0.031, "validation_bft": 96.9}
    >>> print(selection_text(pd.DataFrame([{**row, "chosen": True}])))
    order  horizon  error [%]  validation BFT [%]
        2        9     3.1000               96.90  <- chosen
    """
    lines = ["order  horizon  error [%]  validation BFT [%]"]
    for order, horizon, criterion, validation_bft, chosen in table.to_numpy():
        bft = "-" if np.isnan(validation_bft) else f"{validation_bft:.2f}"
        mark = "  <- chosen" if chosen else ""
        error = f"{100.0 * criterion:.4f}"
        lines.append(f"{order:5.0f}  {horizon:7.0f}  {error:>9}  {bft:>18}{mark}")
    return "\n".join(lines)


def warn_about(
    found: Identified, told: set[str] | None = None, stacklevel: int = 3
) -> None:
    """Tell the user what is wrong with a model that is returned all the same.

    Parameters
    ----------
    found : Identified
    told : set of str, default=None
        Kinds of warnings that were given and are not repeated; grows by these.
    stacklevel : int, default=3
        Of the caller's caller.
    """
    if found.rank_deficit and _is_new("rank", told):
        warnings.warn(
            f"The data leave {found.rank_deficit} directions of B and D "
            "undetermined; the smallest solution was taken. Excite the inputs "
            "more richly, or lower `order`.",
            RankWarning,
            stacklevel=stacklevel,
        )
    warn_about_pole(found.A, told, stacklevel + 1)
    as_found = found.residual - found.stability_loss
    useless = found.residual > 1.0 - _USELESS_FIT
    if found.residual**2 - as_found**2 > _HALF:
        if not _is_new("enforced", told):
            return
        warnings.warn(
            "No stable model explains these outputs: the simulation error is "
            f"{100.0 * found.residual:.0f} % of their size with stability='enforce', "
            f"{100.0 * as_found:.3g} % without. The system seems to be unstable: "
            "identify it with stability='warn', or from a record of bounded outputs, "
            "with the controller's reference as input.",
            UserWarning,
            stacklevel=stacklevel,
        )
    elif useless and _is_new("useless", told):
        warnings.warn(
            "The model explains next to nothing of the outputs: its simulation "
            f"error is {100.0 * found.residual:.0f} % of their size. Try a longer "
            "`horizon` or order='auto', and check that inputs and outputs belong "
            "together and in the order of time.",
            UserWarning,
            stacklevel=stacklevel,
        )


def _is_new(kind: str, told: set[str] | None) -> bool:
    """Whether a kind of warning was not given before; from now on it was."""
    if told is None:
        return True
    new = kind not in told
    told.add(kind)
    return new


def warn_about_pole(
    A: Array, told: set[str] | None = None, stacklevel: int = 3
) -> None:
    """Tell the user that a model is unstable."""
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    if radius > 1.0 + _ROUNDING and _is_new("pole", told):
        warnings.warn(
            f"The identified model is unstable: a pole has modulus {radius:.6g}. "
            "Use stability='enforce' for a stable one, another `order`, or a "
            "longer `horizon`.",
            UserWarning,
            stacklevel=stacklevel,
        )


def warn_about_waiting(n_samples: int, error: Exception, told: set[str]) -> None:
    """Tell the user that a stream has no model yet though its buffer is full."""
    if _is_new("waiting", told):
        warnings.warn(
            f"The first {n_samples:,} samples of the stream leave it without a model, "
            f"and its oldest samples are left out until it has one. {error}",
            UserWarning,
            stacklevel=4,
        )


def warn_about_drift(
    error: float, first: float, n_samples: int, told: set[str]
) -> None:
    """Tell the user where a stream does not go on as its first samples began.

    Parameters
    ----------
    error, first : float
        Relative simulation error, of the stream and of its first samples.
    n_samples : int
        How many those were.
    told : set of str
    """
    useless = 1.0 - _USELESS_FIT
    poor = error > min(useless, max(_POOR_FIT, _MUCH_WORSE * first))
    # What began as poor was reported then, unless it has become worse than no model.
    if poor and error > 1.1 * first and _is_new("drift", told):
        warnings.warn(
            f"The simulation error of the stream is {100.0 * error:.3g} % of the "
            f"outputs, after {100.0 * first:.3g} % over its first {n_samples:,} "
            "samples: these excite the system too little to go on from their model, "
            "or the system or its noise has changed. Begin a stream with samples that "
            "excite what comes later, or `fit` the whole table.",
            UserWarning,
            stacklevel=3,
        )


def warn_about_horizon(
    residual: float, horizon: int, better: tuple[int, float] | None
) -> None:
    """Tell the user when another horizon fits clearly better than the one given."""
    if better is not None:
        warnings.warn(
            f"horizon={horizon} ends in a poor model: its simulation error is "
            f"{100.0 * residual:.3g} % of the outputs, that of horizon {better[0]} is "
            f"{100.0 * better[1]:.3g} %. Use horizon='auto'.",
            UserWarning,
            stacklevel=3,
        )
