"""The whole method: local experiments to a validated LPV model."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, clone
from sklearn.utils.validation import check_is_fitted

from .experiments import Experiment, read_experiments
from .interpolation import PolynomialLPV
from .local_models import LocalModel, identify_point
from .lpv import LPVStateSpace
from .operating_points import check_local, group_operating_points
from .parallel import over_points
from .reports import operating_point_report, point_label
from .restructuring import GrayBoxRestructurer
from .statespace import positive_time
from .structured_models import balanced_entries, help_neighbours, restructure_point
from .structures import GrayBoxStructure
from .subspace import SubspaceLTI

__all__ = ["LocalLPVPipeline"]

Array = NDArray[np.float64]


class LocalLPVPipeline(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Local LPV identification: experiments at operating points to one LPV model.

    Identifies a black-box model at every operating point, brings each into the
    gray-box structure, so that all share one state basis, and interpolates the
    parameters over the scheduling variables. A row of the table is a time instant.

    Parameters
    ----------
    local : estimator, default=None
        Step 3, a black-box model per operating point; None is ``SubspaceLTI()``. Its
        column roles are set by the pipeline. ``order="auto"`` becomes the order of the
        restructurer's structure where it has one.
    restructurer : GrayBoxRestructurer, "passthrough" or None, default=None
        Step 4; None is ``GrayBoxRestructurer()``, the observable canonical form.
        "passthrough" interpolates the entries of the balanced local models: the
        baseline without structure.
    interpolator : regressor, default=None
        Step 5, from scheduling values (n_points, n_scheduling) to parameters
        (n_points, n_params); None is ``PolynomialLPV()``, a parabola. Any scikit-learn
        regressor with several outputs serves.
    inputs, scheduling, experiment, time, operating_point : column name, position or \
list, default=None
        Roles of the columns of X. Inputs None: every column without another role.
        Experiment None: the table is one experiment. Scheduling None: the model is
        time-invariant. Operating point None: experiments are grouped by their mean
        scheduling value.
    scheduling_tol : float, default=None
        Distance below which experiments belong to one operating point; None chooses it
        from the data.
    sampling_time : float, default=None
        Seconds between samples. None reads it from the time column, else takes that of
        `local`.
    combine : {"pool", "average"}, default="pool"
        Several experiments at one operating point enter one fit, or are identified
        one by one and their balanced models averaged (the paper's Monte Carlo).
    discretization : {"zoh", "tustin"}, default="zoh"
        From discrete to continuous time; "zoh" is exact for inputs that are held.
    on_error : {"raise", "skip"}, default="raise"
        What a failure at one operating point does: raise an error that names it, or
        leave the point out with a warning.
    n_jobs : int, default=None
        Operating points worked on at the same time.
    verbose : int, default=0
        1 shows a progress bar.

    Attributes
    ----------
    operating_points_ : ndarray of shape (n_points, n_scheduling)
    local_models_ : list of StateSpace
        Black-box models, continuous time, balanced.
    structured_models_ : list of StateSpace
        Gray-box models (the balanced ones after "passthrough").
    restructurers_ : list
        The fitted restructurers, empty after "passthrough".
    parameters_ : DataFrame of shape (n_points, n_params)
        Gray-box parameters, one row per operating point.
    interpolator_ : fitted regressor
    lpv_ : LPVStateSpace
    report_ : DataFrame
        One row per operating point: experiments, samples, order, BFT of the local and
        of the gray-box model on the estimation data (percent, mean over the outputs),
        restructuring error and its structural floor, both relative to the black box's
        norm, the active frequency (rad/s), stationarity, and the largest relative
        deviation of a parameter from its interpolation.
    step_times_ : dict of str to float
        Seconds that each step took.
    sampling_time_ : float
    n_outputs_, n_features_in_ : int

    See Also
    --------
    SubspaceLTI, GrayBoxRestructurer, PolynomialLPV : The three steps.

    Examples
    --------
    >>> import warnings
    >>> from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline
    >>> from lpvlearn.datasets import make_flexible_arm
    >>> arm = make_flexible_arm(n_operating_points=3, duration=1.0, random_state=0)
    >>> pipeline = LocalLPVPipeline(
    ...     restructurer=GrayBoxRestructurer(arm.structure),
    ...     scheduling="kappa", experiment="experiment", time="time")
    >>> pipeline = pipeline.fit(arm.X, arm.y)
    >>> pipeline.parameters_.shape
    (3, 16)
    >>> bool(pipeline.score(arm.X_sweep, arm.y_sweep) > 0.9)
    True
    """

    def __init__(
        self,
        local: Any = None,
        restructurer: Any = None,
        interpolator: Any = None,
        *,
        inputs: Any = None,
        scheduling: Any = None,
        experiment: Any = None,
        time: Any = None,
        operating_point: Any = None,
        scheduling_tol: float | None = None,
        sampling_time: float | None = None,
        combine: str = "pool",
        discretization: str = "zoh",
        on_error: str = "raise",
        n_jobs: int | None = None,
        verbose: int = 0,
    ) -> None:
        self.local = local
        self.restructurer = restructurer
        self.interpolator = interpolator
        self.inputs = inputs
        self.scheduling = scheduling
        self.experiment = experiment
        self.time = time
        self.operating_point = operating_point
        self.scheduling_tol = scheduling_tol
        self.sampling_time = sampling_time
        self.combine = combine
        self.discretization = discretization
        self.on_error = on_error
        self.n_jobs = n_jobs
        self.verbose = verbose

    # -- fitting -------------------------------------------------------------------

    def fit(self, X: Any, y: Any) -> LocalLPVPipeline:
        """Identify the LPV model from local experiments.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            Inputs, scheduling variables and columns with other roles.
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If a role names no column, an experiment is not local, or a step fails at
            an operating point (which the message names).
        """
        self._check_options()
        start = perf_counter()
        experiments = self._read(X, y, reset=True)
        self._single_output = np.asarray(y).ndim == 1
        self.sampling_time_ = self._sampling_time(experiments)
        index, kappa = group_operating_points(experiments, self.scheduling_tol)
        if kappa.shape[1] == 0:  # no scheduling: one constant stands for it
            kappa = np.zeros((len(kappa), 1))
        else:
            check_local(experiments, kappa)
        groups = [
            [e for e, i in zip(experiments, index, strict=True) if i == k]
            for k in range(len(kappa))
        ]
        self.n_outputs_ = groups[0][0].outputs.shape[1]
        read = perf_counter()
        kept, models = self._identify(groups, kappa)
        groups, kappa = [groups[k] for k in kept], kappa[kept]
        identified = perf_counter()
        kept, structure, theta = self._restructure(kappa)
        restructured = perf_counter()
        groups, kappa = [groups[k] for k in kept], kappa[kept]
        models = [models[k] for k in kept]
        self.operating_points_ = kappa
        self.parameters_ = pd.DataFrame(
            theta,
            index=pd.Index(
                [point_label(k) for k in kappa],
                name="operating_point",
                tupleize_cols=False,
            ),
            columns=list(structure.parameter_names),
        )
        self.interpolator_ = self._interpolator(len(kappa)).fit(kappa, theta)
        bounds = np.array([kappa.min(0), kappa.max(0)])
        self.lpv_ = LPVStateSpace(structure, self.interpolator_, bounds)
        self.report_ = operating_point_report(
            groups,
            models,
            self.structured_models_,
            self.restructurers_,
            self.lpv_,
            kappa,
            self.sampling_time_,
        )
        self.step_times_ = {
            "reading of the table": read - start,
            "local models": identified - read,
            "restructuring": restructured - identified,
            "interpolation and report": perf_counter() - restructured,
        }
        return self

    def _identify(
        self, groups: list[list[Experiment]], kappa: Array
    ) -> tuple[list[int], list[LocalModel]]:
        """Step 3 at every operating point, with one order where one is needed."""
        local = SubspaceLTI() if self.local is None else self.local
        restructurer = self._restructurer()
        structure = getattr(restructurer, "structure", None)
        if structure is not None and _has_auto_order(local):
            local = clone(local).set_params(order=structure.order)
        found = self._identify_all(local, groups, kappa)
        orders = {model.order for model in found if model is not None}
        if structure is None and _has_auto_order(local) and len(orders) > 1:
            local = clone(local).set_params(order=max(orders))
            found = self._identify_all(local, groups, kappa)
        kept = [k for k, model in enumerate(found) if model is not None]
        if not kept:
            raise ValueError("every operating point failed; see the warnings.")
        models = [model for model in found if model is not None]
        self.local_models_ = [model.lti for model in models]
        return kept, models

    def _identify_all(
        self, local: Any, groups: list[list[Experiment]], kappa: Array
    ) -> list[LocalModel | None]:
        return over_points(
            "local models",
            identify_point,
            [(local, group) for group in groups],
            kappa,
            **self._parallel(),
            sampling_time=self.sampling_time_,
            combine=self.combine,
            discretization=self.discretization,
        )

    def _restructure(self, kappa: Array) -> tuple[list[int], GrayBoxStructure, Array]:
        """Step 4 at every operating point, the points helping one another."""
        restructurer = self._restructurer()
        models = self.local_models_
        if restructurer is None:
            self.restructurers_: list[Any] = []
            structure, theta = balanced_entries(models)
            self.structured_models_ = [structure.model(row) for row in theta]
            return list(range(len(models))), structure, theta
        found = over_points(
            "restructuring",
            restructure_point,
            [(model,) for model in models],
            kappa,
            **self._parallel(),
            restructurer=restructurer,
        )
        kept = [k for k, result in enumerate(found) if result is not None]
        if not kept:
            raise ValueError("every operating point failed; see the warnings.")
        self.local_models_ = [models[k] for k in kept]
        fitted = help_neighbours(
            [found[k] for k in kept], self.local_models_, kappa[kept]
        )
        self.restructurers_ = fitted
        self.structured_models_ = [r.lti_ for r in fitted]
        return kept, fitted[0].structure_, np.array([r.params_ for r in fitted])

    # -- use -----------------------------------------------------------------------

    def predict(self, X: Any) -> Array:
        """Simulate the LPV model along every experiment of a table, from rest.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        ndarray of shape (n_samples, n_outputs), or (n_samples,) after a 1-D y
        """
        check_is_fitted(self, "lpv_")
        return self._simulate(self._read(X, None, reset=False), estimate=False)

    def predict_with_initial_state(self, X: Any, y: Any) -> Array:
        """Simulate from initial states estimated on the measured outputs.

        For tables that start in the middle of an experiment: `y` serves for the initial
        state of every experiment only (least squares over the whole experiment).

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)

        Returns
        -------
        ndarray of shape (n_samples, n_outputs), or (n_samples,) after a 1-D y
        """
        check_is_fitted(self, "lpv_")
        return self._simulate(self._read(X, y, reset=False), estimate=True)

    def split_experiments(self, X: Any) -> list[NDArray[np.intp]]:
        """Rows of every experiment of a table, in the order of time."""
        check_is_fitted(self, "lpv_")
        return [e.rows for e in self._read(X, None, reset=False)]

    def _simulate(self, experiments: list[Experiment], estimate: bool) -> Array:
        out = np.empty((sum(len(e.rows) for e in experiments), self.n_outputs_))
        for e in experiments:
            dt = e.sampling_time or self.sampling_time_
            kappa = np.zeros((len(e.rows), 1)) if e.scheduling is None else e.scheduling
            x0 = None
            if estimate:
                forced = self.lpv_.simulate(e.inputs, kappa, dt)
                columns = self.lpv_.free_responses(kappa, dt).reshape(forced.size, -1)
                rest = (e.outputs - forced).ravel()
                x0 = np.linalg.lstsq(columns, rest, rcond=None)[0]
            out[e.rows] = self.lpv_.simulate(e.inputs, kappa, dt, x0)
        return out[:, 0] if self._single_output else out

    # -- helpers -------------------------------------------------------------------

    def _read(self, X: Any, y: Any, *, reset: bool) -> list[Experiment]:
        return read_experiments(
            self,
            X,
            y,
            inputs=self.inputs,
            scheduling=self.scheduling,
            experiment=self.experiment,
            time=self.time,
            operating_point=self.operating_point,
            sampling_time=self.sampling_time if reset else None,
            reset=reset,
        )

    def _sampling_time(self, experiments: list[Experiment]) -> float:
        steps = [e.sampling_time for e in experiments if e.sampling_time is not None]
        if steps:
            return float(np.median(steps))
        if self.sampling_time is not None:
            return positive_time("sampling_time", self.sampling_time)
        return float(getattr(self.local, "sampling_time", 1.0))

    def _parallel(self) -> dict[str, Any]:
        return {
            "n_jobs": self.n_jobs,
            "verbose": self.verbose,
            "on_error": self.on_error,
        }

    def _restructurer(self) -> Any:
        """The restructurer to clone, or None for "passthrough"."""
        if isinstance(self.restructurer, str):
            return None
        if self.restructurer is None:
            return GrayBoxRestructurer()
        return self.restructurer

    def _interpolator(self, n_points: int) -> Any:
        if n_points == 1:  # one point carries a constant
            return PolynomialLPV(degree=0)
        return (
            PolynomialLPV() if self.interpolator is None else clone(self.interpolator)
        )

    def _check_options(self) -> None:
        for name, value, allowed in (
            ("combine", self.combine, ("pool", "average")),
            ("discretization", self.discretization, ("zoh", "tustin")),
            ("on_error", self.on_error, ("raise", "skip")),
        ):
            if value not in allowed:
                raise ValueError(f"`{name}` must be one of {allowed}. Got {value!r}.")
        if isinstance(self.restructurer, str) and self.restructurer != "passthrough":
            raise ValueError(
                "`restructurer` must be an estimator, 'passthrough' or None. Got "
                f"{self.restructurer!r}."
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = True
        return tags


def _has_auto_order(local: Any) -> bool:
    order = local.get_params(deep=False).get("order")
    return isinstance(order, str) and order == "auto"
