"""Polynomials of the scheduling variables through the parameters of local models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Legendre, Polynomial
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray

from ..exceptions import RankWarning, warn
from ..models.scheduling_range import domains, to_unit
from ..validation import one_of, whole_number
from .interpolator import Interpolator, carried_by_terms
from .weighting import WeightedPoints

Array = NDArray[np.float64]

_MOST_TERMS = 10_000  # a dense regression: 0.8 GB for as many points

_BASES = ("power", "chebyshev", "legendre")

# With more scheduling variables than this, the points are a scattered cloud that no
# polynomial grid fills: the minimum-norm surface is then expected, as in any linear
# regression with many features, and not worth a warning.
_MAX_VARIABLES_TO_WARN = 3


class PolynomialLPV(Interpolator):
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
    variables : sequence of int, default=None
        Places of the scheduling variables that the parameters follow; None: all.
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
    chi2_ : float
        Least distance of polynomials from the points, squared, in units of their
        covariances; NaN where these are not known.
    degrees_of_freedom_ : int
        Number of values at the points less that of coefficients.
    weighted_ : bool
        Whether the covariances weigh the points: they are known, and `chi2_` is
        plausible for its degrees of freedom.
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

    Covariances of the parameters, where given and regular at all points, weigh the
    errors: ``sum_i e_i^T P_i^-1 e_i``. If the polynomial is true, nothing is more
    precise. Where its degree is too low the errors are its own, and precise points
    would bend it: then (`chi2_` too large to be chance) the points count alike.

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
        variables: Sequence[int] | None = None,
        extrapolation: str = "ignore",
    ) -> None:
        self.degree = degree
        self.basis = basis
        self.variables = variables
        self.extrapolation = extrapolation

    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        self.powers_ = resolvable_powers(self.degree, kappa)
        terms = self._terms(kappa)
        solution, self.rank_ = points.coefficients(terms)
        self._judge(points, terms @ solution, self.rank_ * points.theta.shape[1])
        if not self.weighted_:
            solution, self.rank_ = points.unweighted().coefficients(terms)
        self._warn_of_rank(kappa)
        self._chebyshev_coef = solution
        self._publish()

    def _publish(self) -> None:
        """Set `coef_`; predictions use the well-conditioned form."""
        with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
            conversion = conversion_to(self.basis, self.powers_, self.scheduling_range_)
            coef = conversion @ self._chebyshev_coef
        if not np.isfinite(coef).all():
            raise ValueError(
                "`X` must have a range whose powers are numbers. Got "
                f"{self.scheduling_range_[0]} to {self.scheduling_range_[1]}; take "
                "another unit, or basis='chebyshev'."
            )
        self.coef_ = coef[:, 0] if self._single_parameter else coef.T

    def _evaluate(self, kappa: Array) -> Array:
        return self._terms(kappa) @ self._chebyshev_coef

    def _coefficients(self) -> Array:
        return self._chebyshev_coef.ravel()

    def _set(self, coefficients: Array) -> None:
        self._chebyshev_coef = coefficients.reshape(self._chebyshev_coef.shape)
        self._publish()

    def _carried(self, outer: Array, kappa: Array) -> Array:
        return carried_by_terms(outer, self._terms(kappa))

    def _terms(self, kappa: Array) -> Array:
        return chebyshev_terms(kappa, self.powers_, self.scheduling_range_)

    def _warn_of_rank(self, kappa: Array) -> None:
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
                "minimum norm was taken. Add operating points that are not on one "
                "curve, or give a lower `degree`.",
                RankWarning,
            )

    def _check_options(self) -> None:
        super()._check_options()
        whole_number("degree", self.degree, 0)
        one_of("basis", self.basis, _BASES)


def powers_up_to(degree: int, highest: NDArray[np.intp]) -> NDArray[np.intp]:
    """Exponents (n_terms, n_variables) of monomials up to a total degree.

    Those of every variable up to its `highest`; by increasing total degree,
    lexicographic within one. Only what is kept is listed.
    """
    degree = min(degree, int(np.sum(highest)))
    powers = np.zeros((1, 0), np.intp)
    for most in np.minimum(highest, degree):
        own = np.tile(np.arange(most + 1), len(powers))
        powers = np.column_stack([np.repeat(powers, most + 1, axis=0), own])
        powers = powers[powers.sum(axis=1) <= degree]
        if len(powers) > _MOST_TERMS:
            raise ValueError(
                f"`degree` must make at most {_MOST_TERMS} terms of all variables. Got "
                f"{degree} for {len(highest)} variables; interpolate by a lower degree."
            )
    return powers[np.lexsort([*-powers.T[::-1], powers.sum(axis=1)])]


def chebyshev_terms(
    kappa: Array, powers: NDArray[np.intp], scheduling_range: Array
) -> Array:
    """Products of Chebyshev polynomials of the mapped values, (n_points, n_terms)."""
    terms = np.ones((len(kappa), len(powers)))
    for scaled, degrees in zip(
        to_unit(kappa, scheduling_range).T, powers.T, strict=True
    ):
        terms *= chebvander(scaled, int(degrees.max(initial=0)))[:, degrees]
    return terms


def conversion_to(
    basis: str, powers: NDArray[np.intp], scheduling_range: Array
) -> Array:
    """The matrix from Chebyshev coefficients to those of `basis`."""
    degree = int(powers.max(initial=0))
    matrix = np.ones((len(powers), len(powers)))
    for j, domain in enumerate(domains(scheduling_range).T.tolist()):
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


def resolvable_powers(
    degree: int, kappa: Array, *, tensor: bool = False
) -> NDArray[np.intp]:
    """The terms up to a degree, total or (tensor) each, that the points tell apart."""
    highest = np.array([len(np.unique(column)) - 1 for column in kappa.T])
    if len(highest) == 1 and degree > highest[0]:
        n_points = highest[0] + 1
        raise ValueError(
            f"`degree` must be at most {highest[0]} for {n_points} operating "
            f"point{'s' if n_points > 1 else ' (1 sample)'}. Got {degree}."
        )
    if tensor:
        highest = np.minimum(degree, highest)
        powers = powers_up_to(int(highest.sum()), highest)
        return powers[np.lexsort([*powers.T[::-1], powers.sum(axis=1)])]
    return powers_up_to(degree, highest)
