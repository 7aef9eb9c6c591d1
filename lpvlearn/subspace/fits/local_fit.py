"""What is kept of a fit: the model, its choice, and what is known of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import DETRENDS
from ..closed_loop.feedback import Feedback
from ..evidence.offsets import Offsets
from ..evidence.statistics import Evidence
from ..orders.identification import Candidate, Settings
from ..orders.selection import Selection
from ..samples.records import ScaledRecords
from ..simulation_error.signals import SharedSignals
from ..simulation_error.simulation_fit import Realization
from .options import Choices

Array = NDArray[np.float64]

_SURELY = 3.0  # standard deviations by which a pole grows beyond chance


class LocalFit(NamedTuple):
    """A fitted model and what is known of it."""

    model: Realization  # of the scaled samples
    singular_values: Array
    residual: float
    stability_loss: float
    selection: Selection
    evidence: Evidence
    method: str  # that made the model
    feedback: Feedback | None  # None where the samples are too few for its test
    offsets: Offsets  # of the experiments, what `detrend` subtracted among them
    scaled: ScaledRecords  # what was fitted as one table; none of a summary
    signals: SharedSignals  # of this model and samples like these

    def settings(self, choices: Choices) -> Settings:
        """How models like it are made."""
        return Settings(
            self.evidence.free,
            self.method,
            choices.refine is not False,
            choices.enforce_stability,
            choices.n_noise_states,
        )

    def worse_than(self, other: LocalFit) -> float:
        """By how much its criterion is above that of another's, one step ahead."""
        return self.evidence.one_step.criterion - other.evidence.one_step.criterion

    def chosen(self, choices: Choices) -> Choices:
        """What was chosen among these for samples that tell the same."""
        evidence, refine = self.evidence, choices.refine
        if refine == "auto" and self.method != "pbsid":
            refine = "simulation" if evidence.whitening.is_none else "prediction"
            refine = refine if evidence.refined or self.stability_loss else False
        return choices._replace(
            order=self.selection.order,
            horizon=self.selection.horizon,
            method=self.method,
            feedthrough=choices.feedthrough if evidence.free.direct.any() else False,
            refine=refine,
            offset=DETRENDS[evidence.free.n_trend],
        )

    def follows(self, order: int, settings: Settings) -> bool:
        """Whether it leads to a model of other samples with these settings."""
        own, free = self.evidence.free, settings.free
        same = own.n_trend == free.n_trend and own.direct.shape == free.direct.shape
        same &= order == self.selection.order and self.method == settings.method
        return same and settings.refine and self.evidence.refined

    def candidate(self, output_scale: Array) -> Candidate:
        """The model of outputs in another scale."""
        evidence, horizon = self.evidence, self.selection.horizon
        ratio = evidence.output_scale / output_scale
        model = evidence.model._replace(C=evidence.model.C * ratio[:, None])
        like = model, horizon, evidence.whitening, evidence.refined
        return Candidate(*like, self.signals)

    def grows(self, *, surely: bool = False) -> bool:
        """Whether a pole is outside the unit circle, `surely` by more than chance."""
        poles = self.evidence.state_space(self.model, 1.0).poles()
        growth, spread = np.abs(poles) - 1.0, np.zeros(len(poles))
        if surely and (growth > 0.0).any():
            try:
                spread = np.abs(self.evidence.poles_std())
            except ValueError:  # it is not known
                return False
        return bool((growth > _SURELY * spread).any())
