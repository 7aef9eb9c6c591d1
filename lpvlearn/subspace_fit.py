"""From experiments to everything that `SubspaceLTI` keeps of a fit."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .excitation import check_excitation, check_size, reduce_inputs
from .missing_data import remove_trends
from .numerics.horizons import better_horizon
from .numerics.identification import Identified, ScaledRecords, identify, scale_records
from .numerics.regression import Freedom
from .numerics.selection import Candidate, Selection, select
from .subspace_options import Choices, feedthrough_mask
from .subspace_statistics import Evidence, shorten

Array = NDArray[np.float64]
Pairs = list[tuple[Array, Array]]


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

    Returns
    -------
    LocalFit

    Raises
    ------
    ValueError
        If an input is constant or the samples are too few.
    """
    check_excitation(pairs, names)
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    pairs, u_offset, y_offset = remove_trends(pairs, detrend)
    pairs, basis = reduce_inputs(pairs)
    mask = feedthrough_mask(feedthrough, n_outputs, n_inputs, basis)
    order, horizon, n_noise_states = choices
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
