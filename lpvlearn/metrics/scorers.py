"""Scorers of estimators that simulate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..data.scoring import tell_missing
from ..validation import one_of, real_array, whole_number
from .scores import Multioutput, accounted_variance, best_fit
from .table_simulation import drop_start, simulate, split, unwrap

InitialState = Literal["rest", "estimate"]

Average = Literal["pool", "experiment"]


@dataclass(frozen=True)
class TrajectoryScorer:
    """A scorer, `scorer(estimator, X, y) -> float`, for estimators that simulate.

    Made by `make_bft_scorer` and `make_vaf_scorer`; usable as `scoring=` wherever
    scikit-learn takes a callable. Samples that were not measured (NaN in `y`) are left
    out, and so are those that cannot be simulated for want of an input; any other
    simulation that is not finite is an error. From rest, a table that starts in
    mid-motion is warned of.

    Attributes
    ----------
    metric : {"BFT", "VAF"}
    initial_state : {"rest", "estimate"}
    burn_in : int
    multioutput : "uniform_average", "raw_values" or tuple of float
    average : {"pool", "experiment"}

    Raises
    ------
    ValueError
        When one of them is something else.
    """

    metric: Literal["BFT", "VAF"]
    initial_state: InitialState = "rest"
    burn_in: int = 0
    multioutput: Multioutput = "uniform_average"
    average: Average = "pool"

    def __post_init__(self) -> None:
        one_of("metric", self.metric, ("BFT", "VAF"))
        check_options(self.initial_state, self.burn_in)
        one_of("average", self.average, ("pool", "experiment"))
        given = self.multioutput
        if not isinstance(given, str):
            weights = real_array("multioutput", given).ravel().tolist()
            object.__setattr__(self, "multioutput", tuple(weights))
        elif given not in ("uniform_average", "raw_values"):
            raise ValueError(
                "`multioutput` of a scorer must be 'uniform_average', 'raw_values' or "
                f"one weight per output. Got {given!r}."
            )

    def __call__(self, estimator: Any, X: Any, y: Any) -> float | dict[str, float]:
        """Score an estimator's simulation of `X` against `y`."""
        score = best_fit if self.metric == "BFT" else accounted_variance
        simulator, X = unwrap(estimator, X)
        found = simulate(simulator, X, y, self.initial_state)
        Y, names = found.measured, found.names
        tell_missing(Y)
        pool = self.average == "pool"
        groups = [np.arange(len(Y))]
        if self.burn_in or not pool:
            groups = drop_start(split(simulator, X), self.burn_in)
        if pool:
            groups = [np.concatenate(groups)]
        scores = [
            score(Y[rows], found.simulated[rows], self.multioutput) for rows in groups
        ]
        if not self.burn_in:
            found.warn_of_motion(simulator, X)
        mean = np.mean(scores, axis=0)
        if self.multioutput != "raw_values":
            return float(mean)
        return {
            f"{self.metric}_{name}": float(value)
            for name, value in zip(names, mean, strict=True)
        }


def make_bft_scorer(
    *,
    initial_state: InitialState = "rest",
    burn_in: int = 0,
    multioutput: Multioutput = "uniform_average",
    average: Average = "pool",
) -> TrajectoryScorer:
    """Make a scorer of the best fit ratio.

    Parameters
    ----------
    initial_state : {"rest", "estimate"}, default="rest"
        State at the start of each experiment. "rest" scores `estimator.predict(X)`;
        "estimate" scores `estimator.predict_with_initial_state(X, y)`, which fits the
        initial state (and levels, see there) to the outputs by least squares: use it
        when a split starts in mid-trajectory, as `TimeSeriesSplit` does.
    burn_in : int, default=0
        Samples at the start of each experiment that are simulated but not scored. The
        estimator's `split_experiments(X)` tells the rows of each experiment.
    multioutput : {"uniform_average", "raw_values"} or array-like of shape (n_outputs,)
        Mean over the outputs, or weights: `[1, 0]` scores the first output alone.
        "raw_values" is one score per output, ``{"BFT_y1": ..., "BFT_y2": ...}``, as
        ``cross_validate(scoring=...)`` takes it.
    average : {"pool", "experiment"}, default="pool"
        Score all experiments as one record, as scikit-learn does, or take the mean of
        their scores, which offsets between experiments cannot flatter.

    Returns
    -------
    TrajectoryScorer

    Raises
    ------
    ValueError
        When an option is not one of those above.

    Examples
    --------
    >>> from lpvlearn import make_bft_scorer
    >>> make_bft_scorer(burn_in=20).burn_in
    20
    """
    return TrajectoryScorer("BFT", initial_state, burn_in, multioutput, average)


def make_vaf_scorer(
    *,
    initial_state: InitialState = "rest",
    burn_in: int = 0,
    multioutput: Multioutput = "uniform_average",
    average: Average = "pool",
) -> TrajectoryScorer:
    """Make a scorer of the variance accounted for.

    Parameters
    ----------
    initial_state : {"rest", "estimate"}, default="rest"
    burn_in : int, default=0
    multioutput : {"uniform_average", "raw_values"} or array-like of shape (n_outputs,)
    average : {"pool", "experiment"}, default="pool"
        As in `make_bft_scorer`.

    Returns
    -------
    TrajectoryScorer

    Raises
    ------
    ValueError
        When an option is not one of those above.

    Examples
    --------
    >>> from lpvlearn import make_vaf_scorer
    >>> make_vaf_scorer(multioutput=[1, 0]).multioutput
    (1.0, 0.0)
    """
    return TrajectoryScorer("VAF", initial_state, burn_in, multioutput, average)


def check_options(initial_state: str, burn_in: int = 0) -> None:
    """Refuse options that scorers, reports and pictures do not know."""
    one_of("initial_state", initial_state, ("rest", "estimate"))
    whole_number("burn_in", burn_in, 0)


bft_scorer = make_bft_scorer()

vaf_scorer = make_vaf_scorer()
