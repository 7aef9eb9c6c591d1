"""Outputs with an integrator: identified from their differences, and integrated.

An integrator is a pole at one that no record tells from a slow one. The rates of the
outputs ``(y[k+1] - y[k]) / dt`` do not have it: their model, with a feedthrough from
the inputs of the step, is stable, and behind ``y[k+1] = y[k] + dt rate[k]`` it is that
of the outputs, exactly. What inputs do to such an output at once, as the current to the
voltage of a battery, is none of its rate, which would know the next sample: that is
taken from the outputs before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from ...data.experiments import Experiment
from ...exceptions import warn
from ...models.statespace import DEVIATION, ModelPair, StateSpace
from ...validation import has_one_axis, is_whole, shown
from ..closed_loop.feedback import Feedback, find_feedback
from ..closed_loop.varx import direct_terms
from ..evidence.constants import USELESS
from ..evidence.statistics import Evidence
from ..samples.records import scale_records
from ..simulation_error.simulation_fit import Freedom, simulation_fit
from .options import feedthrough_mask

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_SEEN = 5.0  # standard deviations of an entry of D that is none by chance

# Share of the squared errors that D must leave where it may be that of a controller,
# which tells of the noise alone.
ACTS = 0.5

_WORSE = 1.05  # of squared errors: those that are whitened are the least, not these


def integrating_flags(integrating: Any, names: Sequence[Any]) -> Flags:
    """Which outputs are named, or all for True.

    >>> integrating_flags("angle", ["angle", "current"])
    array([ True, False])
    """
    if integrating is True:
        return np.ones(len(names), bool)
    given = list(integrating) if has_one_axis(integrating) else [integrating]
    flags, known = np.zeros(len(names), bool), {n: k for k, n in enumerate(names)}
    for one in given or [None]:
        try:
            place = None if isinstance(one, bool) else known.get(one)
        except TypeError:  # what is no name
            place = None
        if place is None and is_whole(one) and 0 <= one < len(flags):
            place = int(one)
        if place is None:
            raise ValueError(
                "`integrating` must be None, True, or name outputs by the columns of "
                f"y, {list(names)}, or their positions. Got {shown(one)}."
            )
        flags[place] = True
    return flags


class Direct(NamedTuple):
    """What inputs do at once to the outputs that integrate."""

    D: Array  # (n_outputs, n_inputs)
    std: Array | None = None  # of its entries; None where they are zero
    sure: bool = True  # or a controller may answer outputs within the sample


def direct_of(
    experiments: Sequence[Experiment], flags: Flags, feedthrough: Any
) -> Direct | None:
    """What acts at once by a regression of the outputs on their past; None if nothing.

    Gaussian signals do not tell it from what a controller answers: surer is a
    `feedthrough` that is a table.
    """
    n_inputs = experiments[0].inputs.shape[1]
    allowed = feedthrough_mask(feedthrough, len(flags), n_inputs, n_inputs)
    allowed = allowed & flags[:, None]
    scaled = scale_records([(e.inputs, e.measured) for e in experiments])
    found = direct_terms(scaled.records) if allowed.any() else None
    if found is None:
        return None
    size = np.outer(scaled.output_scale, 1.0 / scaled.input_scale)
    D, std = (size * x for x in found)
    seen = allowed & (np.abs(D) > _SEEN * std)
    feedback = find_feedback(scaled.records) if seen.any() else None
    if feedback is None or feedback.found:
        return None
    sure = np.ndim(feedthrough) > 0 or feedback.acts_at_once
    return Direct(np.where(seen, D, 0.0), np.where(seen, std, 0.0), sure)


def warn_of_direct(acts: bool) -> None:
    """Tell how it was taken that outputs that integrate follow inputs at once."""
    taken = "The latter was taken, with D = 0"
    if acts:
        taken = "The former was taken, which explains far more"
    warn(
        "Outputs that integrate follow inputs of the same sample. These may act at "
        "once, as a current on the voltage of a battery, or a controller that makes "
        f"them may answer at once. {taken}. Use `feedthrough`, a table of True "
        "and False, to say which."
    )


def without_direct_terms(
    experiments: Sequence[Experiment], D: Array
) -> list[Experiment]:
    """The experiments without what their inputs do to their outputs at once."""
    return [replace(e, outputs=e.measured - e.inputs @ D.T) for e in experiments]


def rates_of(
    experiments: Sequence[Experiment], flags: Flags, step: float
) -> list[Experiment]:
    """The experiments with the rates of some outputs, without their last samples."""
    found = []
    for e in experiments:
        if e.outputs is None or len(e.rows) < 2:
            raise ValueError(
                "`integrating` needs experiments of two samples or more. Got one, "
                f"{e.label!r}, of {len(e.rows)}."
            )
        y = np.where(flags, np.diff(e.outputs, axis=0) / step, e.outputs[:-1])
        kappa = None if e.scheduling is None else e.scheduling[:-1]
        shorter = replace(
            e, rows=e.rows[:-1], inputs=e.inputs[:-1], outputs=y, scheduling=kappa
        )
        found.append(shorter)
    return found


def sums_of(experiments: Sequence[Experiment], step: float) -> list[Experiment]:
    """The experiments with the sums of their inputs, of the outputs' rates.

    With ``U[k] = step (u[0] + ... + u[k - 1])`` outputs that integrate ``G u`` are
    ``G U``, a constant and a transient.
    """
    zero = np.zeros((1, experiments[0].inputs.shape[1]))
    return [
        replace(e, inputs=step * np.cumsum(np.vstack([zero, e.inputs[:-1]]), axis=0))
        for e in experiments
    ]


def without_direct(
    experiments: Sequence[Experiment], rates: Sequence[Experiment]
) -> bool:
    """Whether D = 0 is taken: a controller answers the outputs within the sample.

    That there is one the records of the outputs tell, or of the `rates`; that it
    answers at once those of the outputs, as the inputs of the step act on rates in any
    case.
    """

    def feedback(some: Sequence[Experiment]) -> Feedback | None:
        pairs = [(e.inputs, e.measured) for e in some]
        return find_feedback(scale_records(pairs).records)

    def shows_loop(found: Feedback | None) -> bool:
        return found is not None and found.found and not found.cut_off

    of_outputs = feedback(experiments)
    if of_outputs is None or not of_outputs.instantaneous:
        return False
    if not (shows_loop(of_outputs) or shows_loop(feedback(rates))):
        return False
    warn(
        "A controller answers the outputs within the sample: of those that do not "
        "integrate D = 0 was taken. If it needs a sample to answer, give `feedthrough` "
        "as a table."
    )
    return True


def options_of_rates(
    table: pd.DataFrame, flags: Flags, feedthrough: Any, step: float
) -> dict[str, Any]:
    """Options of a model of the rates that are not those of the outputs' model.

    `table` as of `as_table`, `step` in seconds, or True where nothing tells them.
    Raises a ValueError for a `feedthrough` of another shape.
    """
    *inputs, experiment = table.columns
    # What acts at once follows from how rates are made: a table, which says so.
    given = feedthrough_mask(feedthrough, len(flags), len(inputs), len(inputs))
    direct = given | flags[:, None]
    return {
        "integrating": None,
        "missing": "raise",
        "feedthrough": direct,
        "sampling_time": None if step is True else step,
        "inputs": inputs,
        "experiment": experiment,
        "time": None,
        "scheduling": None,
        "operating_point": None,
    }


def integrated(model: StateSpace, flags: Flags, direct: ArrayLike = 0.0) -> StateSpace:
    """The model of the outputs from that of the rates of some of them.

    `direct` (n_outputs, n_inputs) is what these have of D.

    >>> rate = StateSpace(0.5, 1.0, 1.0, 0.2, sampling_time=1.0)
    >>> integrated(rate, np.array([True])).poles()
    array([0.5+0.j, 1. +0.j])
    """
    E, dt = np.eye(len(flags))[flags], float(model.sampling_time or 1.0)
    n, r = model.order, len(E)
    A = np.block([[model.A, np.zeros((n, r))], [dt * E @ model.C, np.eye(r)]])
    B = np.vstack([model.B, dt * E @ model.D])
    own = ~flags[:, None]
    C = np.hstack([np.where(own, model.C, 0.0), E.T])
    D = np.where(own, model.D, direct)
    return StateSpace(A, B, C, D, model.sampling_time, input_delay=model.input_delay)


def is_poorer(evidence: Evidence, model: StateSpace, other: StateSpace) -> bool:
    """Whether a model explains records worse than another, or grows unlike that.

    What is compared are poles and outputs: the rest is fitted to the records.
    """

    def loss(of: StateSpace) -> float:
        C = of.C / evidence.output_scale[:, None]
        return simulation_fit(of.A, C, evidence.records, evidence.free).loss

    grows = other.is_stable and not model.is_stable
    return grows or loss(model) > _WORSE * loss(other)


def warn_if_useless(residual: float, *, of_rates: bool) -> None:
    """Tell the user that a model explains next to nothing, of outputs or their rates.

    `residual` is its simulation error, relative.
    """
    if residual > USELESS:
        what, noise = "the outputs", ""
        if of_rates:
            what = "the rates of the outputs"
            noise = (
                " Of outputs that hardly move from sample to sample rates are mostly "
                "noise: then look at `score`, or `resample`."
            )
        warn(
            f"The model explains next to nothing of {what}: its simulation error is "
            f"{100.0 * residual:.0f} % of their size. Check that the outputs "
            "integrate, that inputs and outputs belong together, and that rows are in "
            f"the order of time; or leave `integrating` out.{noise}"
        )


@dataclass(frozen=True, eq=False)
class RateEvidence:
    """What is known of a model with integrators: that of the rates, integrated.

    What has no place here (noise, residuals) is known of the rates alone.
    """

    models: list[StateSpace]  # of the rates, to either side: above, below, above, ...
    flags: Flags  # (n_outputs,): which of them integrate
    n_inputs: int
    # (n_outputs, n_inputs): of D of the outputs that integrate; None where it is zero
    direct_std: Array | None = None

    @property
    def free(self) -> Freedom:
        """What is estimated of D."""
        return Freedom(np.ones((len(self.flags), self.n_inputs), bool))

    def deviated_models(self, lti: StateSpace) -> list[ModelPair]:
        """Models to either side, with the integrators."""
        moved = [integrated(model, self.flags, lti.D) for model in self.models]
        std = np.zeros_like(lti.D) if self.direct_std is None else self.direct_std
        for i, j in np.argwhere(std) if moved else ():
            step = np.zeros_like(lti.D)
            step[i, j] = DEVIATION * std[i, j]
            moved += [
                StateSpace(lti.A, lti.B, lti.C, D, lti.sampling_time, lti.input_delay)
                for D in (lti.D + step, lti.D - step)
            ]
        return list(zip(moved[::2], moved[1::2], strict=True))

    @property
    def records(self) -> Any:
        """None: residuals are those of the rates."""
        return self._refuse()

    def _refuse(self, *_: Any) -> Any:
        raise ValueError(
            "with `integrating`, the errors and their statistics are known of the "
            "rates of the outputs. Ask `rates_`, the SubspaceLTI of these."
        )

    predictor = poles_std = _refuse
    frequency_response_covariance = frequency_response_std = _refuse
