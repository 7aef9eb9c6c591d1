"""What all interpolators share: points in, a range, and what happens beyond it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import (
    check_is_fitted,
    validate_data,
)

from ..exceptions import ExtrapolationWarning, VersionedPickle, all_or_nothing, warn
from ..systems.threads import one_blas_thread
from ..validation import (
    SQUARED,
    naming_argument,
    one_of,
    real_array,
    squarable,
    weights,
)
from .extrapolation import describe_extrapolation
from .weighting import WeightedPoints, is_chance, weighted_points

Array = NDArray[np.float64]

_EXTRAPOLATIONS = ("ignore", "warn", "clip", "error")

_POINTS = "be a table of finite numbers, shape (n_points, n_scheduling)"


class Interpolator(
    VersionedPickle, MultiOutputMixin, RegressorMixin, BaseEstimator, ABC
):
    """A regressor from scheduling values to parameters of local models.

    A sample is an operating point. An heir has the option `extrapolation`, tells in
    `_fit` what it makes of points, and in `_evaluate` what it says of other ones.

    Fitted, it is a smooth function of some coefficients: the numbers that a refinement
    moves, and whose covariance is that of all it predicts. `coefficients` has them as a
    vector, `with_coefficients` the same form with others, and `sensitivities` the
    derivatives of what it predicts. An heir tells them in `_coefficients`, `_set` and
    `_carried`.
    """

    extrapolation: str

    @all_or_nothing
    @one_blas_thread
    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
    ) -> Self:
        """Fit the parameters of operating points.

        Parameters
        ----------
        X : array-like of shape (n_points, n_scheduling)
            Scheduling values of the operating points.
        y : array-like of shape (n_points, n_params) or (n_points,)
            Parameters of the local models.
        sample_weight : array-like of shape (n_points,), default=None
            Weights of the squared errors beside each other, not negative; without one
            a point counts as absent. Where a curve meets all points they weigh those
            of one place.
        covariance : array-like of shape (n_points, n_params, n_params), default=None
            Their covariances, or (n_points,) variances of one parameter; of use where
            they are finite and regular at all points.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            When an option is not one of those above, shapes do not fit, or the points
            are too few for the form.

        Warns
        -----
        RankWarning
            When distinct points do not determine every product of two or three
            scheduling variables, of a polynomial.
        """
        self._check_options()
        kappa, points = self._read(X, y, sample_weight, covariance)
        self._fit(kappa, points)
        return self

    def predict(self, X: ArrayLike) -> Array:
        """Evaluate at scheduling values.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_scheduling)
            Scheduling values.

        Returns
        -------
        ndarray of shape (n_samples, n_params), or (n_samples,)
            Parameters; one-dimensional if `y` was.

        Raises
        ------
        ValueError
            When a value is outside of `scheduling_range_` and
            `extrapolation="error"`.

        Warns
        -----
        ExtrapolationWarning
            When a value is outside of it and `extrapolation="warn"`.
        """
        values = self._values(self._place(X))
        return values[:, 0] if self._single_parameter else values

    def score(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> float:
        """Coefficient of determination of `predict`, as scikit-learn's regressors.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_scheduling)
            Scheduling values.
        y : array-like of shape (n_samples, n_params) or (n_samples,)
            Parameters there.
        sample_weight : array-like of shape (n_samples,), default=None
            Weights of the samples.

        Returns
        -------
        float
            1 for equal parameters.

        Raises
        ------
        ValueError
            When a value is too large to be squared, or shapes do not fit.
        """
        y = squarable("y", real_array("y", y))
        if sample_weight is not None:
            sample_weight = weights(sample_weight, len(np.atleast_1d(y)), "point")
        return float(super().score(X, y, sample_weight))

    def coefficients(self) -> Array:
        """The numbers that the fitted form has, one after another.

        Returns
        -------
        ndarray of shape (n_coefficients,)
        """
        check_is_fitted(self)
        return self._coefficients()

    def with_coefficients(self, coefficients: ArrayLike) -> Self:
        """The same form with other coefficients.

        Parameters
        ----------
        coefficients : array-like of shape (n_coefficients,)
            In the order of `coefficients`.

        Returns
        -------
        Interpolator
            A fitted copy. What tells of the fit to the points (`chi2_`, `selection_`)
            stays.

        Raises
        ------
        ValueError
            If the number of coefficients is another, one is not finite, or a
            denominator comes near to zero within the range.

        Examples
        --------
        >>> import numpy as np
        >>> from lpvlearn import PolynomialLPV
        >>> line = PolynomialLPV(1).fit([[0.0], [2.0]], [1.0, 5.0])
        >>> c = line.coefficients()
        >>> higher = line.with_coefficients(c + [1.0, 0.0])
        >>> higher.predict([[0.5]]).round(9), higher.coef_.round(9)
        (array([3.]), array([2., 2.]))
        >>> np.allclose(higher.predict([[0.5]]), line.sensitivities([[0.5]])[0] @ c + 1)
        True
        """
        vector = real_array("coefficients", coefficients)
        if vector.shape != self.coefficients().shape or not np.isfinite(vector).all():
            raise ValueError(
                f"`coefficients` must be {len(self.coefficients())} finite numbers. "
                f"Got shape {vector.shape}."
            )
        changed = type(self).__new__(type(self))  # a copy would draw the curve again
        changed.__dict__.update(self.__dict__)
        rule = "be numbers that make finite curves"
        with (
            np.errstate(over="raise", invalid="raise"),
            naming_argument("coefficients", rule, coefficients),
        ):
            changed._set(vector)
        return changed

    def sensitivities(self, X: ArrayLike, outer: Array | None = None) -> Array:
        """Derivatives of what `predict` says by the coefficients.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_scheduling)
            Scheduling values; out of range as `predict` has them.
        outer : ndarray of shape (n_samples, n_rows, n_params), default=None
            Derivatives of something else by the parameters; None is the identity.

        Returns
        -------
        ndarray of shape (n_samples, n_params, n_coefficients)
            With the covariance P of the coefficients, the parameters at sample i have
            the covariance ``S[i] @ P @ S[i].T`` to first order. With `outer`, the
            derivatives ``outer[i] @ S[i]`` of that, for less.
        """
        kappa = self._place(X)
        with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
            outer = self._identity(kappa) if outer is None else outer
            return self._finite(kappa, self._carried(outer, kappa))

    def information(self, X: ArrayLike, covariance: ArrayLike) -> Array | None:
        """What operating points tell of the coefficients.

        Parameters
        ----------
        X : array-like of shape (n_points, n_scheduling)
            Operating points.
        covariance : array-like of shape (n_points, n_params, n_params)
            Covariances ``P_i`` of the parameters there.

        Returns
        -------
        ndarray of shape (n_coefficients, n_coefficients) or None
            ``sum_i S_i^T P_i^-1 S_i``, the inverse of the coefficients' covariance
            where the form is true. Where `chi2_` is not plausible, divided by it per
            degree of freedom: what is left of the points is the form's own error then.
            None where a covariance is not known.
        """
        kappa = self._place(X)
        points = weighted_points(self._evaluate(kappa), np.ones(len(kappa)), covariance)
        if points.whitening is None:
            return None
        rows = self._carried(points.whitening, kappa)
        rows = rows.reshape(-1, rows.shape[2])
        return rows.T @ rows / self._excess()

    def _values(self, kappa: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
            return self._finite(kappa, self._evaluate(kappa))

    def _finite(self, kappa: Array, values: Array) -> Array:
        finite = (np.abs(values) < SQUARED).reshape(len(kappa), -1).all(axis=1)
        if not finite.all():
            raise ValueError(
                "`X` must hold scheduling values near the range of the fit, where "
                f"parameters are finite. Got {kappa[finite.argmin()]} in row "
                f"{finite.argmin()}, for a range from {self.scheduling_range_[0]} to "
                f"{self.scheduling_range_[1]}."
            )
        return values

    def _identity(self, kappa: Array) -> Array:
        q = self._evaluate(kappa[:1]).shape[1]
        return np.broadcast_to(np.eye(q), (len(kappa), q, q))

    def _excess(self) -> float:
        """Variance of points about the form, in units of what is known; 1 at least."""
        chi2 = getattr(self, "chi2_", np.nan)
        dof = getattr(self, "degrees_of_freedom_", 0)
        implausible = np.isfinite(chi2) and dof > 0 and not is_chance(chi2, dof)
        return chi2 / dof if implausible else 1.0

    def _place(self, X: ArrayLike) -> Array:
        """Checked scheduling values; what is out of range is told or clipped."""
        check_is_fitted(self)
        self._check_options()
        with naming_argument("X", _POINTS, X):
            kappa = validate_data(self, X, dtype=np.float64, reset=False)
        if self.extrapolation == "clip":
            kappa = np.clip(kappa, *self.scheduling_range_)
        elif self.extrapolation != "ignore":
            message = describe_extrapolation(kappa, self.scheduling_range_)
            if message and self.extrapolation == "error":
                raise ValueError(message)
            if message:
                warn(message, ExtrapolationWarning)
        return kappa

    @abstractmethod
    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        """Fit points; `scheduling_range_` is known."""

    @abstractmethod
    def _evaluate(self, kappa: Array) -> Array:
        """Parameters (n_samples, n_params) at checked values."""

    @abstractmethod
    def _coefficients(self) -> Array:
        """Coefficients (n_coefficients,)."""

    @abstractmethod
    def _set(self, coefficients: Array) -> None:
        """Take others, and leave alone what a copy shares."""

    @abstractmethod
    def _carried(self, outer: Array, kappa: Array) -> Array:
        """Derivatives by the parameters, (n_samples, n_rows, n_params) at checked
        values, carried to the coefficients."""

    def _check_options(self) -> None:
        one_of("extrapolation", self.extrapolation, _EXTRAPOLATIONS)

    def _read(
        self,
        X: Any,
        y: Any,
        sample_weight: ArrayLike | None,
        covariance: ArrayLike | None,
    ) -> tuple[Array, WeightedPoints]:
        """Scheduling values and points, without those of weight zero."""
        with naming_argument("X", f"{_POINTS}, beside `y`", X):
            kappa, params = validate_data(
                self, X, y, dtype=np.float64, multi_output=True, y_numeric=True
            )
        weight = np.ones(len(kappa))
        if sample_weight is not None:
            weight = weights(sample_weight, len(kappa), "point")
        self._single_parameter = params.ndim == 1
        theta = real_array("y", params).reshape(len(kappa), -1)
        squarable("X", kappa), squarable("y", theta)
        # A point of weight zero counts as absent, for the range too.
        kappa = kappa[weight > 0]
        self.scheduling_range_ = np.array([kappa.min(axis=0), kappa.max(axis=0)])
        held = ~self._follows()
        kappa[:, held] = kappa[:1, held]
        return kappa, weighted_points(theta, weight, covariance)

    def _follows(self) -> NDArray[np.bool_]:
        """Which scheduling variables the form follows."""
        n, variables = self.scheduling_range_.shape[1], getattr(self, "variables", None)
        if variables is None:
            return np.ones(n, dtype=bool)
        places = np.asarray(variables)
        if (
            places.ndim != 1
            or not np.issubdtype(places.dtype, np.integer)
            or not np.isin(places, np.arange(n)).all()
        ):
            raise ValueError(
                f"`variables` must be places of scheduling variables, from 0 to {n - 1}"
                f", or None for all. Got {variables!r}."
            )
        return np.isin(np.arange(n), places)

    def _judge(
        self, points: WeightedPoints, values: Array, n_coefficients: int
    ) -> None:
        """Tell whether a form with these values at the points may be true."""
        known = points.whitening is not None
        self.degrees_of_freedom_ = points.theta.size - n_coefficients
        self.chi2_ = points.misfit(values) if known else np.nan
        self.weighted_ = known and points.is_plausible(
            self.chi2_, self.degrees_of_freedom_
        )


def carried_by_terms(outer: Array, terms: Array) -> Array:
    """Derivatives ``outer`` by ``terms @ N`` carried to the entries of N, row by row.

    `outer` (n_samples, n_rows, n_params); `terms` (n_samples, n_terms), or (n_samples,
    n_terms, n_params) where those of the parameters differ.
    """
    each = terms[:, :, None] if terms.ndim == 2 else terms
    carried = outer[:, :, None, :] * each[:, None]
    return carried.reshape(*outer.shape[:2], each.shape[1] * outer.shape[2])
