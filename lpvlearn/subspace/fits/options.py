"""Options of `SubspaceLTI`, checked, and what of them decides about a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import DETRENDS
from ...validation import is_whole, one_of, positive_time, real_array, shown
from ..evidence.offsets import N_TRENDS
from ..orders.identification import Settings
from ..orders.realization import METHODS
from ..simulation_error.simulation_fit import Freedom

Array = NDArray[np.float64]

REFINEMENTS = ("auto", "simulation", "prediction")

MISSING = ("raise", "split", "estimate")

_MOST = 1_000  # orders to choose among


class Choices(NamedTuple):
    """Checked options that decide about a fit.

    The method "auto" is "pbsid" where there is feedback, or noise moves the plant, else
    "po-moesp".
    """

    order: int | None = None  # None is to be chosen
    horizon: int | None = None
    n_noise_states: int = 0
    method: str = "auto"
    feedthrough: Any = True
    refine: str | bool = "auto"
    enforce_stability: bool = False
    initial_states: bool = True  # False starts every experiment from rest
    offset: str | None = None  # "auto" is to be chosen
    # of every experiment, (n_samples, n_outputs): outputs that are estimates; none: ()
    estimated: Sequence[NDArray[np.bool_]] = ()
    differences: bool = False  # whether the samples are those of others
    orders: tuple[int, ...] = ()  # ascending, to choose among; (): all

    def settings(
        self, n_outputs: int, n_inputs: int, basis: Array, n_trend: int = 0
    ) -> Settings:
        """How models of these channels are made.

        `basis` (n_inputs, rank) are the original inputs in terms of the independent
        ones, which the models have; `n_trend` as in `Freedom`.
        """
        mask = feedthrough_mask(self.feedthrough, n_outputs, n_inputs, basis.shape[1])
        return Settings(
            Freedom(mask, self.initial_states, n_trend),
            self.method,
            self.refine is not False,
            self.enforce_stability,
            self.n_noise_states,
            weigh=self.refine in ("auto", "prediction"),
            compare=self.refine == "auto",
            differences=self.differences,
            orders=self.orders,
        )


def check_options(options: Mapping[str, Any]) -> Choices:
    """Refuse what is not an option of `SubspaceLTI`, naming those that are."""
    one_of("method", options["method"], ("auto", *METHODS, "pbsid"))
    one_of("stability", options["stability"], ("warn", "enforce"))
    one_of("initial_state", options["initial_state"], ("estimate", "rest"))
    one_of("missing", options["missing"], MISSING)
    one_of("detrend", options["detrend"], DETRENDS)
    one_of("offset", options["offset"], tuple(N_TRENDS))
    one_of("refine", options["refine"], (*REFINEMENTS, True, False))
    mask = _feedthrough(options["feedthrough"])
    if options["sampling_time"] is not None:
        positive_time("sampling_time", options["sampling_time"])
    if options["initial_state"] == "rest" and options["missing"] == "split":
        raise ValueError(
            "`initial_state` must be 'estimate' with missing='split': what follows a "
            "gap does not start from rest. Got 'rest'."
        )
    offset = options["offset"]
    if options["detrend"] is not None and offset == "auto":
        offset = None  # what is to become of offsets was said
    order, orders = _order(options["order"])
    return Choices(
        order,
        _integer_or_auto("horizon", options["horizon"], 1),
        _integer_or_auto("n_noise_states", options["n_noise_states"], 0) or 0,
        options["method"],
        mask if mask.ndim else bool(mask),
        REFINEMENTS[0] if options["refine"] is True else options["refine"],
        options["stability"] == "enforce",
        options["initial_state"] == "estimate",
        offset,
        orders=orders,
    )


def check_for_completion(detrend: str | None) -> None:
    """Refuse what the completion of missing outputs does not take."""
    if detrend is not None:
        raise ValueError(
            "`detrend` must be None with missing='estimate': means of outputs that are "
            f"not there are not known. Got {detrend!r}. Use offset={detrend!r}."
        )


def check_for_rates(options: Mapping[str, Any]) -> None:
    """Refuse what the rates of integrating outputs do not take."""
    detrend, offset = options["detrend"], options["offset"]
    if options["missing"] == "estimate":
        raise ValueError(
            "`missing` must be 'raise' or 'split' with `integrating`: the rates of "
            "missing outputs are not estimated. Got 'estimate'."
        )
    if detrend is not None or offset == "linear":
        raise ValueError(
            "`integrating` needs detrend=None, and another offset than 'linear': "
            f"constants of the rates are straight lines. Got {detrend=}, {offset=}."
        )


def choices_of_each(options: Mapping[str, Any]) -> Choices:
    """As `check_options`, of which `fit_each` takes not all."""
    if options["missing"] == "estimate":
        raise ValueError(
            "`missing` must be 'raise' or 'split' in fit_each. Got 'estimate'. Use "
            "`fit` for every experiment."
        )
    if options["integrating"] is not None:
        raise ValueError(
            f"`integrating` must be None in fit_each. Got {options['integrating']!r}. "
            "Give it the rates of the outputs, or `fit` every experiment."
        )
    return check_options(options)


def choices_of_stream(options: Mapping[str, Any]) -> Choices:
    """As `check_options`, of which `partial_fit` takes not all."""
    choices = check_options(options)
    detrend, input_delay = options["detrend"], options["input_delay"]
    if options["missing"] == "estimate":
        raise ValueError(
            "`missing` must be 'raise' or 'split' in partial_fit, which never sees "
            "what comes after a gap. Got 'estimate'. Use `fit` for it."
        )
    if options["integrating"] is not None:
        raise ValueError(
            "`integrating` must be None in partial_fit. Got "
            f"{options['integrating']!r}. Give it the rates of the outputs, or use "
            "`fit`."
        )
    if detrend is not None:
        raise ValueError(
            "`detrend` must be None in partial_fit, which never sees a whole "
            f"experiment. Got {detrend!r}. Use offset={detrend!r}."
        )
    if isinstance(input_delay, str):
        raise ValueError(
            "`input_delay` must be a number in partial_fit, which keeps so many "
            f"samples from batch to batch. Got {input_delay!r}. Find it by "
            "`fit` of a first part of the record, in `input_delay_`."
        )
    if choices.method == "pbsid":
        raise ValueError(
            "`method` must not be 'pbsid' in partial_fit: of a stream, what it "
            "needs is not kept. `fit` the table as a whole, or, if the plant "
            "stands in no feedback loop, leave method='auto'."
        )
    return choices._replace(method="po-moesp") if choices.method == "auto" else choices


def _order(value: Any) -> tuple[int | None, tuple[int, ...]]:
    """The order, or None and those among which it is to be chosen: () for "auto"."""
    listed = isinstance(value, np.ndarray) and value.ndim == 1
    if not listed and not isinstance(value, range | list | tuple):
        return _integer_or_auto("order", value, 0), ()
    some = value[: _MOST + 1]
    if not 0 < len(some) <= _MOST or not all(is_whole(n) and n >= 0 for n in some):
        raise ValueError(
            f"`order` must be 'auto', an integer of at least 0, or 1 to {_MOST} such "
            f"integers, as range(2, 7). Got {shown(value)}."
        )
    several = tuple(sorted({int(n) for n in some}))
    return (several[0], ()) if len(several) == 1 else (None, several)


def _integer_or_auto(name: str, value: Any, lowest: int) -> int | None:
    if isinstance(value, str) and value == "auto":
        return None
    if not is_whole(value) or value < lowest:
        raise ValueError(
            f"`{name}` must be 'auto' or an integer of at least {lowest}. Got "
            f"{shown(value)}."
        )
    return int(value)


def _feedthrough(value: Any) -> NDArray[np.bool_]:
    """The option as one or a table of booleans."""
    try:
        mask = real_array("feedthrough", value)
    except ValueError:
        mask = np.full(1, np.nan)
    if not np.isin(mask, (0.0, 1.0)).all():
        raise ValueError(
            "`feedthrough` must be True, False or a table of them, shape (n_outputs, "
            f"n_inputs). Got {shown(value)}."
        )
    return mask.astype(bool)


def feedthrough_mask(
    feedthrough: Any, n_outputs: int, n_inputs: int, rank: int
) -> NDArray[np.bool_]:
    """Free entries of D for the independent inputs, (n_outputs, rank)."""
    mask = _feedthrough(feedthrough)
    if mask.ndim == 0:
        return np.full((n_outputs, rank), mask)
    if mask.shape != (n_outputs, n_inputs):
        raise ValueError(
            "`feedthrough` must be True, False or a table of shape (n_outputs, "
            f"n_inputs) = ({n_outputs}, {n_inputs}). Got shape {mask.shape}."
        )
    if rank == n_inputs or mask.all() or not mask.any():
        return mask[:, :rank]
    raise ValueError(
        "`feedthrough` cannot fix single entries of D while inputs are collinear. "
        "Leave all but one of the collinear inputs out."
    )
