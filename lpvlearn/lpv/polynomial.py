"""Polynomials of the scheduling variables through the parameters of local models."""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any, Self

import numpy as np
from numpy.polynomial import Chebyshev, Legendre, Polynomial
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import (
    check_array,
    check_consistent_length,
    check_is_fitted,
    validate_data,
)

from ..exceptions import ExtrapolationWarning, RankWarning, warn
from ..validation import one_of, whole_number

_BASES = ("power", "chebyshev", "legendre")
_EXTRAPOLATIONS = ("ignore", "warn", "clip", "error")

# Values this close to the identified range, relative to its width, are in it: a
# measured mean and a range read from a report differ by rounding.
_RANGE_RTOL = 1e-6

# With more scheduling variables than this, the points are a scattered cloud that no
# polynomial grid fills: the minimum-norm surface is then expected, as in any linear
# regression with many features, and not worth a warning.
_MAX_VARIABLES_TO_WARN = 3


class PolynomialLPV(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Polynomial interpolation of local models' parameters over scheduling variables.

    A sample is an operating point: `X` holds its scheduling values, `y` the parameters
    of its local model.

    Parameters
    ----------
    degree : int, default=2
        Total degree of the polynomial in all scheduling variables.
    basis : {"power", "chebyshev", "legendre"}, default="power"
        Basis of the published coefficients `coef_`; predictions do not depend on it.
        The orthogonal polynomials take each scheduling variable mapped linearly from
        `scheduling_range_` to [-1, 1]; powers take it as it is.
    extrapolation : {"ignore", "warn", "clip", "error"}, default="ignore"
        What `predict` does outside of `scheduling_range_`: evaluate the polynomial
        without or with an `ExtrapolationWarning`, hold the value at the border, or
        raise.

    Attributes
    ----------
    coef_ : ndarray of shape (n_params, n_terms), or (n_terms,) for a 1-D `y`
        Coefficients of the terms in `powers_`. With one scheduling variable and powers,
        column `k` belongs to the k-th power.
    powers_ : ndarray of int, shape (n_terms, n_scheduling)
        Degree of each term in each scheduling variable, by increasing total degree.
    scheduling_range_ : ndarray of shape (2, n_scheduling)
        Smallest and largest scheduling values of the points with positive weight.
    rank_ : int
        Number of independent terms; below `n_terms`, `coef_` has minimum norm.
    n_features_in_ : int
        Number of scheduling variables.
    feature_names_in_ : ndarray of shape (n_features_in_,)
        Names of the scheduling variables, when `X` has them.

    Notes
    -----
    Equation (35) of the paper, for every entry theta of the model's matrices,

    .. math:: \\theta(\\kappa) = \\theta_0 + \\theta_1 \\kappa + \\dots
              + \\theta_d \\kappa^d,

    and all products of total degree at most d for several scheduling variables. The
    coefficients minimise the (weighted) sum of squared errors over the points. The
    least-squares problem is solved for Chebyshev polynomials on the range of the
    points, where it is well conditioned, and the solution is converted to `basis`.

    Among several scheduling variables, one that takes only m distinct values enters
    with powers up to m - 1: two levels carry a straight line, whatever the degree.
    With more terms than points left, the solution of minimum norm is taken.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import PolynomialLPV
    >>> kappa = np.array([[-1.0], [0.0], [0.5], [2.0]])
    >>> theta = np.column_stack([3 - 2 * kappa, kappa**2])
    >>> model = PolynomialLPV(degree=2).fit(kappa, theta)
    >>> np.abs(model.coef_ - [[3, -2, 0], [0, 0, 1]]).max() < 1e-12
    np.True_
    >>> model.predict([[1.0]]).round(12)
    array([[1., 1.]])
    """

    def __init__(
        self,
        degree: int = 2,
        *,
        basis: str = "power",
        extrapolation: str = "ignore",
    ) -> None:
        self.degree = degree
        self.basis = basis
        self.extrapolation = extrapolation

    def fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Fit the polynomial by least squares.

        Parameters
        ----------
        X : array-like of shape (n_points, n_scheduling)
            Scheduling values of the operating points.
        y : array-like of shape (n_points, n_params) or (n_points,)
            Parameters of the local models.
        sample_weight : array-like of shape (n_points,), optional
            Weights of the squared errors, not negative.

        Returns
        -------
        self : PolynomialLPV

        Raises
        ------
        ValueError
            When an option is not one of those above, or the only scheduling variable
            takes fewer than `degree + 1` distinct values.

        Warns
        -----
        RankWarning
            When distinct points do not determine every product of two or three
            scheduling variables.
        """
        self._check_options()
        points, params = validate_data(
            self, X, y, dtype=np.float64, multi_output=True, y_numeric=True
        )
        weight = _check_weight(sample_weight, points)
        # A point of weight zero counts as absent, for the range too.
        used = weight > 0
        kappa, theta = points[used], params[used].astype(np.float64)
        self.scheduling_range_ = np.array([kappa.min(axis=0), kappa.max(axis=0)])
        self.powers_ = _resolvable_powers(self.degree, kappa)
        root = np.sqrt(weight[used])[:, None]
        terms = self._terms(kappa)
        solution, _, rank, _ = np.linalg.lstsq(
            root * terms, root * theta.reshape(len(theta), -1), rcond=None
        )
        self.rank_ = int(rank)
        self._warn_of_rank(kappa)
        coef = _conversion(self.basis, self.powers_, self.scheduling_range_) @ solution
        # Predictions use the well-conditioned form, not the published one.
        self._chebyshev_coef = solution[:, 0] if params.ndim == 1 else solution
        self.coef_ = coef[:, 0] if params.ndim == 1 else coef.T
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.float64]:
        """Evaluate the polynomial.

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
        check_is_fitted(self)
        self._check_options()
        kappa = validate_data(self, X, dtype=np.float64, reset=False)
        if self.extrapolation == "clip":
            kappa = np.clip(kappa, *self.scheduling_range_)
        elif self.extrapolation != "ignore":
            message = _describe_extrapolation(kappa, self.scheduling_range_)
            if message and self.extrapolation == "error":
                raise ValueError(message)
            if message:
                warn(message, ExtrapolationWarning)
        return self._terms(kappa) @ self._chebyshev_coef

    def _terms(self, kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        """The Chebyshev terms at scheduling values, (n_points, n_terms)."""
        terms = np.ones((len(kappa), len(self.powers_)))
        for j, (low, high) in enumerate(_domains(self.scheduling_range_)):
            scaled = (2 * kappa[:, j] - (low + high)) / (high - low)
            terms *= chebvander(scaled, self.degree)[:, self.powers_[:, j]]
        return terms

    def _warn_of_rank(self, kappa: NDArray[np.float64]) -> None:
        """Warn of terms that distinct operating points leave open."""
        n_points, n_scheduling = kappa.shape
        open_terms = self.rank_ < len(self.powers_)
        few = n_scheduling <= _MAX_VARIABLES_TO_WARN
        # Repeated rows are replicates on a few designed levels, where the minimum norm
        # is as good between the levels as any other choice.
        if open_terms and few and len(np.unique(kappa, axis=0)) == n_points:
            warn(
                f"{n_points} operating points determine only {self.rank_} of the "
                f"{len(self.powers_)} terms of degree {self.degree}: the polynomial of "
                "minimum norm was taken. Lower `degree`, or add operating points that "
                "are not on one curve.",
                RankWarning,
            )

    def _check_options(self) -> None:
        whole_number("degree", self.degree, 0)
        one_of("basis", self.basis, _BASES)
        one_of("extrapolation", self.extrapolation, _EXTRAPOLATIONS)


def total_degree_powers(degree: int, n_variables: int) -> NDArray[np.intp]:
    """Exponents (n_terms, n_variables) of all monomials up to a total degree.

    By increasing total degree, lexicographic within one.
    """
    factors = (
        product
        for total in range(degree + 1)
        for product in combinations_with_replacement(range(n_variables), total)
    )
    return np.array(
        [np.bincount(np.array(f, int), minlength=n_variables) for f in factors]
    )


def _domains(scheduling_range: NDArray[np.float64]) -> list[tuple[float, float]]:
    """The interval of each variable; of width 2 around a constant one."""
    return [
        (low, high) if high > low else (low - 1.0, low + 1.0)
        for low, high in scheduling_range.T.tolist()
    ]


def _conversion(
    basis: str, powers: NDArray[np.intp], scheduling_range: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The matrix from Chebyshev coefficients to those of `basis`."""
    degree = int(powers.max(initial=0))
    matrix = np.ones((len(powers), len(powers)))
    for j, domain in enumerate(_domains(scheduling_range)):
        kinds: dict[str, dict[str, Any]] = {
            "power": {"kind": Polynomial},
            "chebyshev": {"kind": Chebyshev, "domain": domain},
            "legendre": {"kind": Legendre, "domain": domain},
        }
        single = np.zeros((degree + 1, degree + 1))
        for k in range(degree + 1):
            converted = Chebyshev.basis(k, domain=domain).convert(**kinds[basis])
            single[: len(converted.coef), k] = converted.coef
        matrix *= single[powers[:, None, j], powers[None, :, j]]
    return matrix


def _check_weight(
    sample_weight: ArrayLike | None, X: NDArray[np.float64]
) -> NDArray[np.float64]:
    if sample_weight is None:
        return np.ones(len(X))
    weight = check_array(
        sample_weight, dtype=np.float64, ensure_2d=False, input_name="sample_weight"
    )
    if weight.ndim != 1:
        raise ValueError(
            f"`sample_weight` must be one-dimensional. Got shape {weight.shape}."
        )
    check_consistent_length(X, weight)
    if weight.min() < 0 or weight.max() == 0:
        raise ValueError(
            "`sample_weight` must be non-negative and not all zero. Got values from "
            f"{weight.min():g} to {weight.max():g}."
        )
    return weight


def _resolvable_powers(degree: int, kappa: NDArray[np.float64]) -> NDArray[np.intp]:
    """The terms up to a degree whose powers the points can tell apart."""
    highest = np.array([len(np.unique(column)) - 1 for column in kappa.T])
    if len(highest) == 1 and degree > highest[0]:
        n_points = highest[0] + 1
        raise ValueError(
            f"`degree` must be at most {highest[0]} for {n_points} operating "
            f"point{'s' if n_points > 1 else ' (1 sample)'}. Got {degree}."
        )
    powers = total_degree_powers(degree, len(highest))
    return powers[(powers <= highest).all(axis=1)]


def _describe_extrapolation(
    X: NDArray[np.float64], scheduling_range: NDArray[np.float64]
) -> str:
    """Say how far values are out of range; nothing when they are in it."""
    low, high = scheduling_range
    excess = np.maximum(low - X, X - high) - _RANGE_RTOL * (high - low)
    if not (excess > 0).any():
        return ""
    row, j = np.unravel_index(np.argmax(excess), excess.shape)
    outside = int((excess > 0).any(axis=1).sum())
    return (
        f"Scheduling values must be within the identified range, [{low[j]:.6g}, "
        f"{high[j]:.6g}] for variable {j + 1}. Got {outside} of {len(X)} outside, the "
        f"farthest {X[row, j]:.6g}. A polynomial is not to be trusted there: identify "
        "a model there too, or hold the border's value with `extrapolation='clip'`."
    )
