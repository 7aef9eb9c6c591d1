"""The score of a simulation from rest, and whether the experiments start there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.metrics import r2_score

from ..exceptions import DivergenceError, VersionedPickle, collected, warn
from ..validation import SQUARED, squarable, weights
from .alignment import align_outputs
from .containers import OutputContainer
from .tables import read_outputs

Array = NDArray[np.float64]

# BFT (percent) that an estimated initial state must win: a score wrong by less misleads
# nobody, and order / n_samples of the errors' energy is won by chance.
_GAIN = 2.0

# The energy of the transient at the start, relative to the mean of that of the same
# shape in later windows of the errors, follows about the F distribution by chance,
# whatever the colour of the errors, as they are compared with themselves: with the
# degrees of freedom of a mode, and of the windows. (Of 400 models of about the right
# order, scored on 60 to 1500 samples with noise at 0 to 40 dB, 8 starts at rest were
# taken for motion, all among noise slower than 60 samples are long, and 170 of the 203
# starts in motion that cost more than 10 points were found.)
_MODE, _CHANCE = 2, 1e-3

_AS_GOOD = 1.1  # times the errors: those of another level alone, beside a state and it

_SETTLED = 0.99  # share of its energy within which a transient is over
_WINDOWS = 8  # of that length in a record; of a longer transient the start will do


class ScoredFromRest(
    OutputContainer, VersionedPickle, MultiOutputMixin, RegressorMixin, BaseEstimator
):
    """A regressor of tables whose score is that of a simulation from rest.

    It tells of motion, and of outputs left out.
    """

    def score(
        self: Any, X: Any, y: Any, sample_weight: ArrayLike | None = None
    ) -> float:
        """Coefficient of determination of the simulation from rest.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)
            Samples of which an output is missing (NaN) are left out.
        sample_weight : array-like of shape (n_samples,), default=None

        Returns
        -------
        float
            Mean over the outputs, as :func:`sklearn.metrics.r2_score`.

        Warns
        -----
        UserWarning
            If an experiment starts in mid-motion, which a simulation from rest misses.
        """
        y = align_outputs(X, y, self)
        measured, simulated = read_outputs(y)[0], read_outputs(self.predict(X))[0]
        if measured.shape != simulated.shape:
            raise ValueError(
                f"`y` must have shape {simulated.shape}, as what the model simulates. "
                f"Got {measured.shape}."
            )
        known = ~np.isnan(measured).any(axis=1)
        if not known.any():
            raise ValueError(
                "`y` must hold at least 1 measured sample of all outputs. Got none in "
                f"{len(measured)} rows."
            )
        tell_missing(measured)
        weight = None
        if sample_weight is not None:
            weight = weights(sample_weight, len(measured))[known]
            weights(weight, len(weight), "measured row")
        squarable("y", measured[known])
        with np.errstate(over="ignore", invalid="ignore"):
            score = r2_score(measured[known], simulated[known], sample_weight=weight)
        if not np.isfinite(score) and known.sum() > 1:
            rows = np.flatnonzero(known)
            at = np.argmax(np.abs(simulated[rows]))
            row, i = rows[at // simulated.shape[1]], at % simulated.shape[1]
            raise DivergenceError(
                f"R2 is beyond all numbers: output {i} is simulated as "
                f"{simulated[row, i]:.4g} in row {row}, and measured as "
                f"{measured[row, i]:.4g}. A simulation by an unstable model diverges: "
                "use BFT or VAF (`make_bft_scorer`), which are 0 then, or "
                "`predict_ahead`."
            )
        warn_of_motion(self, X, y, simulated)
        return float(score)


def tell_missing(measured: Array) -> None:
    """Tell how many values of outputs were not measured, and so are not scored."""
    n_missing = int(np.count_nonzero(np.isnan(measured)))
    if n_missing:
        warn(
            f"{n_missing} of {measured.size} values of the outputs are missing, and "
            "were left out of the score. Use `fit_report` to see how many of each."
        )


def warn_of_motion(estimator: Any, X: Any, y: Any, simulated: Array) -> None:
    """Warn, once, where outputs simulated from rest miss how an experiment starts.

    That is where an initial state estimated from the measured `y` (like X in length and
    order) lowers the errors clearly, by a transient that is larger than what of the
    same shape is found in the errors later on.
    """
    if not hasattr(estimator, "predict_with_initial_state"):
        return
    measured = read_outputs(y)[0]
    experiments = estimator.split_experiments(X)
    if not any(_may_gain(measured[rows], simulated[rows]) for rows in experiments):
        return
    with collected(), np.errstate(all="ignore"):  # predict has said what there is
        estimated = read_outputs(estimator.predict_with_initial_state(X, y))[0]
    n_late = int(np.sum(getattr(estimator, "input_delay_", 0)))
    for rows in experiments:
        known = np.where(np.isnan(estimated[rows]), np.nan, measured[rows])
        if _starts_in_motion(known, simulated[rows], estimated[rows], n_late):
            warn(
                "The scored table starts in mid-motion, or rests elsewhere than the "
                "model: a simulation from rest misses what the system brings along, "
                "and its score is too low. Splits must keep experiments whole "
                "(ExperimentSplit); where they cannot, or are whole, score with "
                "make_bft_scorer(initial_state='estimate') or, of samples after the "
                "transient, make_bft_scorer(burn_in=...)."
            )
            return


def _may_gain(measured: Array, simulated: Array) -> bool:
    """Whether errors of an experiment are so large that a transient may matter."""
    known = ~np.isnan(measured)
    error = np.where(known, measured - simulated, 0.0)
    with np.errstate(all="ignore"):
        mean = measured.sum(axis=0, where=known) / known.sum(axis=0)
        size = np.linalg.norm(np.where(known, measured - mean, 0.0), axis=0)
        shares = np.linalg.norm(error, axis=0) / size
        return not 100.0 * np.mean(np.minimum(shares, 1.0)) <= _GAIN  # or NaN


def _starts_in_motion(
    measured: Array, from_rest: Array, estimated: Array, n_late: int
) -> bool:
    """Whether an experiment does, by its outputs (NaN: missing) and two simulations.

    `n_late` inputs in transit are estimated along with the state.
    """
    known = ~np.isnan(measured)
    finite = np.isfinite(from_rest) & np.isfinite(estimated)
    if not known.any(axis=0).all() or not finite[known].all():
        return False
    centred = np.where(known, measured - np.nanmean(measured, axis=0), 0.0)
    size = np.linalg.norm(centred, axis=0)
    if not size.all():
        return False
    before, after = ((measured - x) / size for x in (from_rest, estimated))
    about_level = np.where(known, before - np.nanmean(before, axis=0), 0.0)
    before, after = (np.where(known, x, 0.0) for x in (before, after))
    if np.linalg.norm(about_level) <= _AS_GOOD * np.linalg.norm(after):
        return False  # another level, and no motion
    transient = before - after
    if not np.abs(transient).max() < np.sqrt(SQUARED):  # it diverges
        return False
    errors = [np.minimum(np.linalg.norm(x, axis=0), 1.0) for x in (before, after)]
    if 100.0 * np.mean(errors[0] - errors[1]) <= _GAIN:
        return False
    energy = np.cumsum(np.sum(transient**2, axis=1))
    length = 1 + int(np.searchsorted(energy, _SETTLED * energy[-1]))
    length = min(length, len(measured) // _WINDOWS)
    if length == 0:
        return False
    shape = transient[:length]
    starts = range(length, len(measured) - length + 1, max(1, length // 2))
    later = [np.sum(after[s : s + length] * shape) ** 2 for s in starts]
    found = np.sum(before[:length] * shape) ** 2
    chance, n_windows = float(np.mean(later)), len(measured) // length - 1
    ratio = found / max(chance, np.finfo(float).eps * found)
    dof = _MODE + n_late
    return bool(fdtrc(dof, n_windows, ratio / dof) < _CHANCE)
