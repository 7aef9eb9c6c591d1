"""What estimators have in common that hold an LPV model, once it is fitted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from ..data.experiments import Experiment, read_experiments
from ..data.preparation import read_runs
from ..data.scoring import ScoredFromRest
from ..data.tables import n_rows_of
from ..data.timestamps import check_unit
from ..lpv.extrapolation import warn_extrapolation
from ..lpv.model import LPVStateSpace
from ..metrics.table_simulation import simulate_experiments
from ..validation import flag
from .checks.bands import prediction_std
from .running.workers import end_what_begins_with_this_process

Array = NDArray[np.float64]


class ScheduledEstimator(ScoredFromRest, ABC):
    """Simulates tables with the model `lpv_` that an heir fits to one."""

    sampling_time: float | None
    time: Any
    lpv_: LPVStateSpace
    output_errors_: pd.DataFrame
    sampling_time_: float
    scheduling_range_: Array
    scheduling_names_: list[Any]

    @property
    @abstractmethod
    def _splits(self) -> bool:
        """Whether experiments are cut where samples are missing."""

    @property
    def _output_names(self) -> Any:
        return getattr(self, "output_names_", None)

    def __sklearn_clone__(self) -> Any:
        """Searches ask for a clone when they have workers to begin that fit it."""
        end_what_begins_with_this_process()
        return super().__sklearn_clone__()

    def predict(self, X: Any, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Simulate the LPV model along every experiment of a table, from rest.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        return_std : bool, default=False
            Whether to return standard deviations of the outputs too: the column "total"
            of `prediction_std`.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs), or (n_samples,) after a 1-D y
            A table after ``set_output(transform="pandas")``.
        std : ndarray of the same shape
            With `return_std`. A band of 95 % is 1.96 of them to both sides.

        Raises
        ------
        ValueError
            If `return_std` asks for what is not known.
        DivergenceError
            If the outputs overflow, for the model is unstable along an experiment.

        Warns
        -----
        ExtrapolationWarning
            Where a scheduling variable leaves `scheduling_range_`; of several, where
            they leave the convex hull of the operating points, where local experiments
            told some.
        """
        check_is_fitted(self, "lpv_")
        return_std = flag("return_std", return_std)
        y = self._simulate(self._read(X, None), X, estimate=False)
        if not return_std:
            return y
        total = self.prediction_std(X).xs("total", axis=1, level="part").to_numpy()
        return y, self._contained(total, X, self.lpv_.output_names)

    def prediction_std(self, X: Any) -> pd.DataFrame:
        """Standard deviations of the outputs that `predict` gives, part by part.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        DataFrame of shape (n_samples, 4 n_outputs)
            For every output the columns

            - "parameters": by the covariance of the coefficients, ``lpv_.covariance``,
              to first order;
            - "model_error": of the model's own, "model_error" of `output_errors_`, the
              same at all times;
            - "total": of the output without noise, the root of the sum of their
              squares;
            - "measurement": of an output that is measured, with the "noise" too.

        Raises
        ------
        ValueError
            If ``lpv_.covariance`` is not known.

        Notes
        -----
        Local experiments do not show what the model misses while the scheduling
        variables move; a `refiner` sees that on experiments that do. Without one the
        bands are those of a model that is true in motion, and may be far too narrow.
        Where no form of the interpolation meets the points but for their noise, the
        covariance is multiplied by chi-square per degree of freedom. Offsets count as
        known. See :ref:`guide_bands`.
        """
        check_is_fitted(self, "lpv_")
        return prediction_std(
            self.lpv_,
            self.output_errors_,
            self._read(X, None),
            self.sampling_time_,
            X,
        )

    def predict_with_initial_state(self, X: Any, y: Any) -> Array:
        """Simulate from initial states estimated on the measured outputs.

        For tables that start in the middle of an experiment: `y` serves for the initial
        state of every experiment only (least squares over the whole experiment).

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)
            Missing outputs (NaN) are left out.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs), or (n_samples,) after a 1-D y
            Where experiments are cut at missing samples (``missing="split"``), NaN at
            missing inputs or scheduling values; the simulation begins anew after them.
        """
        check_is_fitted(self, "lpv_")
        return self._simulate(self._read(X, y, outputs=False), X, estimate=True)

    def split_experiments(self, X: Any) -> list[NDArray[np.intp]]:
        """Rows of every experiment of a table, in the order of time."""
        check_is_fitted(self, "lpv_")
        gaps = "Xy" if self._splits else ""
        found = read_experiments(self, X, reset=False, allow_missing=gaps)
        return [e.rows for e in found]

    def _simulate(
        self, experiments: list[Experiment], X: Any, *, estimate: bool
    ) -> Any:
        signals = [e.scheduling for e in experiments if e.scheduling is not None]
        clips = getattr(self.lpv_.interpolator, "extrapolation", None) == "clip"
        if signals and not clips:
            self._tell_extrapolation(np.vstack(signals))
        model = self.lpv_.silenced()  # said above, of all experiments at once
        out = simulate_experiments(
            model, experiments, self.sampling_time_, n_rows_of(X), estimate=estimate
        )
        return self._contained(out, X, model.output_names)

    def _tell_extrapolation(self, kappa: Array) -> None:
        """Warn of values (n_samples, n_scheduling) beyond those identified."""
        warn_extrapolation(kappa, self.scheduling_range_, self.scheduling_names_)

    def _read(
        self, X: Any, y: Any, *, reset: bool = False, **options: Any
    ) -> list[Experiment]:
        """Experiments of a table; options as in `read_runs`."""
        declared = self.sampling_time if reset else None
        options |= {"split": self._splits, "reset": reset, "sampling_time": declared}
        experiments = read_runs(self, X, y, **options)
        if not reset:  # another step will do, but hardly another unit
            for e in experiments:
                check_unit(e.sampling_time, self.sampling_time_, self.time)
        return experiments

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = True
        return tags
