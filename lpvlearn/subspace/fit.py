"""From experiments to everything that `SubspaceLTI` keeps of a fit."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import (
    Pairs,
    check_excitation,
    independent_inputs,
    remove_trends,
)
from ..exceptions import RankWarning, warn
from .identification import Identified, ScaledRecords, identify, scale_records
from .options import Choices, check_size, feedthrough_mask, tell
from .selection import Candidate, Selection, better_horizon, select
from .simulation_fit import Freedom, Realization
from .statistics import Evidence, shorten

Array = NDArray[np.float64]


class TooFewSamples(ValueError):
    """The samples do not tell enough for a model; more of them may."""


class LocalFit(NamedTuple):
    """A fitted model and what is known of it.

    Attributes
    ----------
    model : Realization
        Of the scaled samples.
    singular_values : ndarray
    residual, stability_loss : float
        As the attributes of `SubspaceLTI`.
    selection : Selection
    evidence : Evidence
    input_offset, output_offset : ndarray
        What `detrend` subtracted.
    found : Identified
        From `scaled`, the samples that were fitted as one table: all of them, or the
        first ones of a long table or a stream.
    scaled : ScaledRecords
    """

    model: Realization
    singular_values: Array
    residual: float
    stability_loss: float
    selection: Selection
    evidence: Evidence
    input_offset: Array
    output_offset: Array
    found: Identified
    scaled: ScaledRecords


def fit_pairs(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    *,
    detrend: str | None = None,
    names: Sequence[Hashable] | None = None,
) -> LocalFit:
    """Check, detrend, choose and identify.

    Parameters
    ----------
    pairs : list of (u, y)
        One per experiment.
    choices : Choices
    told : set of str
        Kinds of warnings that were given and are not repeated.
    detrend : {None, "constant", "linear"}, default=None
    names : sequence, default=None
        Of the inputs, for messages.

    Returns
    -------
    LocalFit

    Raises
    ------
    TooFewSamples
        If an input is constant or the samples are too few.
    """
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    try:
        check_excitation(pairs, names)
        pairs, u_offset, y_offset = remove_trends(pairs, detrend)
        pairs, basis = _with_independent_inputs(pairs, told)
        mask = feedthrough_mask(choices.feedthrough, n_outputs, n_inputs, basis)
        check_size([len(u) for u, _ in pairs], basis.shape[1], n_outputs, choices)
    except ValueError as error:
        raise TooFewSamples(str(error)) from None
    scaled = scale_records(pairs)
    settings = choices._replace(feedthrough=mask)._asdict()
    order, horizon = settings.pop("order"), settings.pop("horizon")
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
        model=found.scaled_model,
        records=records,
        input_scale=scaled.input_scale,
        output_scale=scaled.output_scale,
        basis=basis,
        free=Freedom(mask, choices.initial_states),
        refined=choices.refine and found.stability_loss == 0.0,
        share=share,
    )
    return LocalFit(
        found.scaled_model,
        found.singular_values,
        found.residual,
        found.stability_loss,
        chosen,
        evidence,
        u_offset,
        y_offset,
        found,
        scaled,
    )


def _with_independent_inputs(pairs: Pairs, told: set[str]) -> tuple[Pairs, Array]:
    """Replace collinear inputs by independent combinations of them, and say so.

    The input matrix in the original inputs is that of the new ones times ``basis.T``,
    the second value; the identity in the usual case.
    """
    n_inputs = pairs[0][0].shape[1]
    basis = independent_inputs([u for u, _ in pairs])
    if basis is None:
        return pairs, np.eye(n_inputs)
    tell(
        told,
        "collinear",
        f"The {n_inputs} inputs are collinear (rank {basis.shape[1]}): their separate "
        "effects are not identifiable and the smallest solution was taken. Excite the "
        "inputs independently.",
        RankWarning,
    )
    return [(u @ basis, y) for u, y in pairs], basis


def warn_about_horizon(fitted: LocalFit, choices: Choices) -> None:
    """Tell the user when another horizon fits clearly better than the one given."""
    better = better_horizon(
        fitted.found._replace(residual=fitted.residual),
        fitted.scaled,
        fitted.selection.horizon,
        fitted.evidence.free,
        method=choices.method,
        refine=choices.refine,
        enforce_stability=choices.enforce_stability,
    )
    if better is not None:
        warn(
            f"horizon={choices.horizon} ends in a poor model: its simulation error is "
            f"{100.0 * fitted.residual:.3g} % of the outputs, that of horizon "
            f"{better[0]} is {100.0 * better[1]:.3g} %. Use horizon='auto'."
        )
