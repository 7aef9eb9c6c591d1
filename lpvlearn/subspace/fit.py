"""From experiments to everything that `SubspaceLTI` keeps of a fit."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import (
    check_excitation,
    independent_inputs,
    reduce_inputs,
    remove_trends,
)
from .identification import Identified, ScaledRecords, identify, scale_records
from .options import Choices, check_size, feedthrough_mask
from .selection import Candidate, Selection, better_horizon, select
from .simulation_fit import Freedom
from .statistics import Evidence, shorten

Array = NDArray[np.float64]

Pairs = list[tuple[Array, Array]]


class TooFewSamples(ValueError):
    """The samples do not tell enough for a model; more of them may."""


class LocalFit(NamedTuple):
    """Result of `fit_pairs`.

    Attributes
    ----------
    found : Identified
    selection : Selection
    evidence : Evidence
    scaled : ScaledRecords
    input_offset, output_offset : ndarray
    """

    found: Identified
    selection: Selection
    evidence: Evidence
    scaled: ScaledRecords
    input_offset: Array
    output_offset: Array


def fit_pairs(
    pairs: Pairs,
    choices: Choices,
    *,
    feedthrough: Any,
    initial_states: bool,
    detrend: str | None,
    names: Sequence[Hashable] | None,
    options: dict[str, Any],
    told: set[str] | None = None,
) -> LocalFit:
    """Check, detrend, choose and identify.

    Parameters
    ----------
    pairs : list of (u, y)
        One per experiment.
    choices : Choices
    feedthrough : bool or array-like of bool
    initial_states : bool
        False starts every experiment from rest.
    detrend : {None, "constant", "linear"}
    names : sequence or None
        Of the inputs, for messages.
    options : dict
        `method`, `refine`, `enforce_stability` of `identify`.
    told : set of str, default=None
        Kinds of warnings that were given and are not repeated.

    Returns
    -------
    LocalFit

    Raises
    ------
    TooFewSamples
        If an input is constant or the samples are too few.
    """
    with _more_may_help():
        check_excitation(pairs, names)
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    pairs, u_offset, y_offset = remove_trends(pairs, detrend)
    known = told is not None and "collinear" in told
    pairs, basis = _reduce_quietly(pairs) if known else reduce_inputs(pairs)
    if told is not None and basis.shape[0] > basis.shape[1]:
        told.add("collinear")
    order, horizon, n_noise_states = choices
    with _more_may_help():
        mask = feedthrough_mask(feedthrough, n_outputs, n_inputs, basis)
        check_size(pairs, order, horizon, options["method"])
    settings = {
        **options,
        "feedthrough": mask,
        "n_noise_states": n_noise_states,
        "initial_states": initial_states,
    }
    scaled = scale_records(pairs)
    chosen = None
    if order is None or horizon is None:
        chosen = select(scaled.records, order, horizon, **settings)
        order, horizon = chosen.order, chosen.horizon
    found = identify(pairs, order, horizon, scaled=scaled, **settings)
    if chosen is None:
        only = Candidate(order, horizon, found.residual, np.nan)
        chosen = Selection(order, horizon, [only])
    records, share = shorten(scaled.records)
    evidence = Evidence(
        found.scaled_model,
        records,
        found.input_scale,
        found.output_scale,
        basis,
        Freedom(mask, initial_states),
        bool(options["refine"]) and found.stability_loss == 0.0,
        share,
    )
    return LocalFit(found, chosen, evidence, scaled, u_offset, y_offset)


def check_for_all_samples(
    n_samples: int,
    n_inputs: int,
    n_outputs: int,
    choices: Choices,
    feedthrough: Any,
    method: str,
) -> None:
    """Refuse what no table of these channels, up to this length, can carry.

    Parameters
    ----------
    n_samples, n_inputs, n_outputs : int
    choices : Choices
    feedthrough : bool or array-like of bool
    method : str

    Raises
    ------
    ValueError

    Examples
    --------
    >>> check_for_all_samples(900, 1, 1, Choices(9, 5, 0), True, "po-moesp")
    Traceback (most recent call last):
    ValueError: `order` must be at most 4 for 900 samples and horizon 5. Got 9.
    """
    feedthrough_mask(feedthrough, n_outputs, n_inputs, np.eye(n_inputs))
    # Only the shapes are looked at.
    u, y = (np.broadcast_to(0.0, (n_samples, k)) for k in (n_inputs, n_outputs))
    check_size([(u, y)], choices.order, choices.horizon, method)


def _reduce_quietly(pairs: Pairs) -> tuple[Pairs, Array]:
    """`reduce_inputs` where the user was told already."""
    found = independent_inputs([u for u, _ in pairs])
    if found is None:
        return pairs, np.eye(pairs[0][0].shape[1])
    return [(u @ found, y) for u, y in pairs], found


@contextmanager
def _more_may_help() -> Iterator[None]:
    """Tell refusals of this table from those of any table."""
    try:
        yield
    except ValueError as error:
        raise TooFewSamples(str(error)) from None


def find_better_horizon(
    fitted: LocalFit, options: dict[str, Any]
) -> tuple[int, float] | None:
    """Another horizon that fits clearly better than the one of a fit, if any."""
    return better_horizon(
        fitted.found,
        fitted.scaled,
        fitted.selection.horizon,
        fitted.evidence.free,
        **options,
    )
