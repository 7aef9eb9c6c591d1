"""Options of `SubspaceLTI`: what is allowed, chosen, and told to the user."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.preparation import DETRENDS
from ..exceptions import RankWarning, warn
from ..validation import one_of, positive_time
from .identification import max_horizon, max_order
from .realization import METHODS
from .selection import Candidate, Selection
from .simulation_fit import Realization

Array = NDArray[np.float64]


class Choices(NamedTuple):
    """Checked options that decide about a fit, as `identify` and `select` name them.

    Attributes
    ----------
    order, horizon : int or None
        None is to be chosen.
    n_noise_states : int
        Additional states of the subspace step.
    method : str
    feedthrough : bool or array-like of bool
    refine, enforce_stability : bool
    initial_states : bool
        False starts every experiment from rest.
    """

    order: int | None = None
    horizon: int | None = None
    n_noise_states: int = 0
    method: str = "po-moesp"
    feedthrough: Any = True
    refine: bool = True
    enforce_stability: bool = False
    initial_states: bool = True


def check_options(options: Mapping[str, Any]) -> Choices:
    """Refuse what is not an option, naming those that are.

    Parameters
    ----------
    options : mapping
        The parameters of a `SubspaceLTI` by name.

    Returns
    -------
    Choices

    Raises
    ------
    ValueError
    """
    one_of("method", options["method"], METHODS)
    one_of("stability", options["stability"], ("warn", "enforce"))
    one_of("initial_state", options["initial_state"], ("estimate", "rest"))
    one_of("missing", options["missing"], ("raise", "split"))
    one_of("detrend", options["detrend"], DETRENDS)
    if options["sampling_time"] is not None:
        positive_time("sampling_time", options["sampling_time"])
    if options["initial_state"] == "rest" and options["missing"] == "split":
        raise ValueError(
            "`initial_state` must be 'estimate' with missing='split': what follows a "
            "gap does not start from rest. Got 'rest'."
        )
    return Choices(
        _integer_or_auto("order", options["order"], 0),
        _integer_or_auto("horizon", options["horizon"], 1),
        _integer_or_auto("n_noise_states", options["n_noise_states"], 0) or 0,
        options["method"],
        options["feedthrough"],
        bool(options["refine"]),
        options["stability"] == "enforce",
        options["initial_state"] == "estimate",
    )


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


def check_size(
    lengths: Sequence[int], n_inputs: int, n_outputs: int, choices: Choices
) -> None:
    """Refuse a horizon or an order that the number of samples cannot carry.

    Parameters
    ----------
    lengths : sequence of int
        Samples of every experiment.
    n_inputs, n_outputs : int
    choices : Choices

    Raises
    ------
    ValueError

    Examples
    --------
    >>> check_size([900], 1, 1, Choices(order=9, horizon=5))
    Traceback (most recent call last):
    ValueError: `order` must be at most 4 for 900 samples and horizon 5. Got 9.
    """
    order, horizon = choices.order, choices.horizon
    longest = max_horizon(lengths, n_inputs, n_outputs)
    if horizon is not None and horizon > longest:
        raise ValueError(
            f"`horizon` must be at most {longest} for {sum(lengths)} samples of "
            f"{n_inputs} input(s) and {n_outputs} output(s). Got {horizon}. Use "
            "horizon='auto' or more samples."
        )
    used = longest if horizon is None else horizon
    highest = max_order(used, n_inputs, n_outputs, choices.method)
    if order is not None and order > highest:
        raise ValueError(
            f"`order` must be at most {highest} for {sum(lengths)} samples and horizon "
            f"{used}. Got {order}."
        )


def feedthrough_mask(
    feedthrough: Any, n_outputs: int, n_inputs: int, basis: Array
) -> NDArray[np.bool_]:
    """Free entries of D for the (independent) inputs.

    Parameters
    ----------
    feedthrough : bool or array-like of bool, shape (n_outputs, n_inputs)
    n_outputs, n_inputs : int
    basis : ndarray of shape (n_inputs, rank)
        Original inputs in terms of the independent ones.

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
    mask, rank = mask.astype(bool), basis.shape[1]
    if rank == n_inputs or mask.all() or not mask.any():
        return mask[:, :rank]
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


# A model that leaves more than this share of the outputs' size unexplained is reported.
_USELESS = 0.9

# Enforced stability that takes the model more than this share of the outputs' energy.
_HALF = 0.5

# An integrator's pole may lie this far outside the unit circle by rounding.
_ROUNDING = 1e-8

# A stream fits much worse than its first samples where its error exceeds theirs by
# this factor, and this share of the outputs' size.
_MUCH_WORSE, _POOR = 5.0, 0.2

# What was poor from the start was told then; it is told again where it grows by this.
_GROWN = 1.1


def tell(
    told: set[str], kind: str, message: str, category: type[Warning] = UserWarning
) -> None:
    """Warn of a kind of thing that was not told before; from now on it was."""
    if kind not in told:
        told.add(kind)
        warn(message, category)


def warn_about(
    model: Realization, residual: float, stability_loss: float, told: set[str]
) -> None:
    """Tell the user what is wrong with a model that is returned all the same.

    Parameters
    ----------
    model : Realization
    residual, stability_loss : float
        As the attributes of `SubspaceLTI`.
    told : set of str
        Kinds of warnings that were given and are not repeated; grows by these.
    """
    if model.rank_deficit:
        tell(
            told,
            "rank",
            f"The data leave {model.rank_deficit} directions of B and D "
            "undetermined; the smallest solution was taken. Excite the inputs "
            "more richly, or lower `order`.",
            RankWarning,
        )
    warn_about_pole(model.A, told)
    as_found = residual - stability_loss
    if residual**2 - as_found**2 > _HALF:
        tell(
            told,
            "enforced",
            "No stable model explains these outputs: the simulation error is "
            f"{100.0 * residual:.0f} % of their size with stability='enforce', "
            f"{100.0 * as_found:.3g} % without. The system seems to be unstable: "
            "identify it with stability='warn', or from a record of bounded outputs, "
            "with the controller's reference as input.",
        )
    elif residual > _USELESS:
        tell(
            told,
            "useless",
            "The model explains next to nothing of the outputs: its simulation "
            f"error is {100.0 * residual:.0f} % of their size. Try a longer "
            "`horizon` or order='auto', and check that inputs and outputs belong "
            "together and in the order of time.",
        )


def warn_about_pole(A: Array, told: set[str]) -> None:
    """Tell the user that a model is unstable."""
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    if radius > 1.0 + _ROUNDING:
        tell(
            told,
            "pole",
            f"The identified model is unstable: a pole has modulus {radius:.6g}. "
            "Use stability='enforce' for a stable one, another `order`, or a "
            "longer `horizon`.",
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
    poor = error > min(_USELESS, max(_POOR, _MUCH_WORSE * first))
    if poor and error > _GROWN * first:
        tell(
            told,
            "drift",
            f"The simulation error of the stream is {100.0 * error:.3g} % of the "
            f"outputs, after {100.0 * first:.3g} % over its first {n_samples:,} "
            "samples: these excite the system too little to go on from their model, "
            "or the system or its noise has changed. Begin a stream with samples that "
            "excite what comes later, or `fit` the whole table.",
        )
