"""Rational functions of the scheduling variables, with one denominator for all.

``theta(kappa) = N^T phi(kappa) / (1 + d^T psi(kappa))``: what equations
``M(kappa) x' = K(kappa) x`` with polynomial M and K give. For a given denominator the
numerators are a linear least-squares problem, so that a search has only d to find
(variable projection).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth, solve_triangular

from ..systems.least_squares import levenberg_marquardt
from ..validation import one_of, whole_number
from .interpolator import Interpolator, carried_by_terms
from .polynomial import chebyshev_terms, resolvable_powers
from .weighting import WeightedPoints, noise_explains

Array = NDArray[np.float64]

_TERMS = ("total", "tensor")

# The denominator has no zero within the range widened by the first share of it on
# either side: a sweep overshoots the outermost of the points. Nor is it smaller there
# than the second share of its largest value. The next pair where with those before no
# function is plausible: the pole of a length, or a mass, is where that is zero, and
# squares of lengths from one to twenty are small at that end. At last the margin leaves
# this share of the way to zero, however near that is.
_LEAST = 0.02
_LIMITS = (0.1, _LEAST), (0.02, _LEAST), (0.02, 0.002)
_TO_ZERO = 0.5

_EXACT = 1e-6  # mean square in the spread of values that are the function's own

# Places over that range where the denominator is looked at; of many variables, the
# corners, and then the points alone.
_PLACES = 4096

_MAX_ITERATIONS = 50
_SAME = (
    1e-8  # relative change of the misfit, or of the coefficients, that ends a search
)


class RationalLPV(Interpolator):
    """Rational interpolation with one denominator for all parameters.

    A sample is an operating point: `X` holds its scheduling values, `y` the parameters
    of its local model.

    Parameters
    ----------
    degree : int, default=2
        Of the numerators, one for every parameter.
    denominator : int, default=2
        Degree of the denominator; 0 is a polynomial. Lowered where the numerators leave
        fewer values at the points than it has coefficients.
    terms : {"total", "tensor"}, default="total"
        With several scheduling variables: `degree` and `denominator` limit the sum of
        the powers in a product, or every one of them.
    variables : sequence of int, default=None
        Places of the scheduling variables that the parameters follow; None: all.
    extrapolation : {"ignore", "warn", "clip", "error"}, default="ignore"
        What `predict` does outside of `scheduling_range_`: evaluate without or with an
        `ExtrapolationWarning`, hold the value at the border, or raise.

    Attributes
    ----------
    numerator_ : ndarray of shape (n_terms, n_params)
        Coefficients of products of Chebyshev polynomials in the scheduling variables,
        each mapped linearly from `scheduling_range_` to [-1, 1].
    denominator_ : ndarray of shape (n_denominator_terms,)
        The same of the denominator; the first is 1.
    powers_ : ndarray of int, shape (n_terms, n_scheduling)
        Degree of each term in each scheduling variable.
    denominator_powers_ : ndarray of int, shape (n_denominator_terms, n_scheduling)
    scheduling_range_ : ndarray of shape (2, n_scheduling)
    rank_ : int
        Number of independent terms of a numerator.
    chi2_ : float
        Least distance from the points, squared, in units of their covariances; NaN
        where these are not known.
    degrees_of_freedom_ : int
        Number of values at the points less that of coefficients.
    weighted_ : bool
        Whether the covariances weigh the points: they are known, and `chi2_` is
        plausible for its degrees of freedom.
    n_features_in_ : int
        Number of scheduling variables.

    Notes
    -----
    Minimises ``sum_i |theta(kappa_i) - theta_i|^2``, weighed by the covariances where
    `weighted_`, else by the spread of every parameter over the points. Sanathanan and
    Koerner's iteration and the polynomial are starts of a Levenberg-Marquardt search on
    this error itself.

    The denominator is positive, 0.02 of its largest value at least, within the range
    of the points and a margin of 10 % of its width on either side. Where no such
    function is plausible by the covariances, or without these meets the points, the
    margin is 2 %, and then 0.002 of its largest value will do at the border; at last
    the margin is half the way to zero, where a variable has one sign and comes near it:
    the pole of what is inverse to a mass, or to a time. Beyond there may be a pole.

    References
    ----------
    C. Sanathanan, J. Koerner, Transfer function synthesis as a ratio of two complex
    polynomials. IEEE Transactions on Automatic Control 8, 1963.

    Examples
    --------
    A mass that grows with the scheduling variable, on a spring: stiffness and damping
    over mass.

    >>> import numpy as np
    >>> from lpvlearn import RationalLPV
    >>> kappa = np.array([[0.0], [1.0], [2.0], [4.0]])
    >>> theta = np.hstack([8 + kappa, 1 + 0 * kappa]) / (1 + kappa / 2)
    >>> model = RationalLPV(degree=1, denominator=1).fit(kappa, theta)
    >>> model.predict([[3.0]]).round(9)
    array([[4.4, 0.4]])
    """

    def __init__(
        self,
        degree: int = 2,
        denominator: int = 2,
        *,
        terms: str = "total",
        variables: Sequence[int] | None = None,
        extrapolation: str = "ignore",
    ) -> None:
        self.degree = degree
        self.denominator = denominator
        self.terms = terms
        self.variables = variables
        self.extrapolation = extrapolation

    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        tensor = self.terms == "tensor"
        self.powers_ = resolvable_powers(self.degree, kappa, tensor=tensor)
        n, q = len(np.unique(kappa, axis=0)), points.theta.shape[1]
        spare = (n - len(self.powers_)) * q
        for degree in range(min(self.denominator, n - 1), -1, -1):
            self.denominator_powers_ = resolvable_powers(degree, kappa, tensor=tensor)
            if len(self.denominator_powers_) <= max(spare, 0) + 1:
                break
        phi = self._terms(kappa, self.powers_)
        psi = self._terms(kappa, self.denominator_powers_)[:, 1:]
        alike, plausible, explained = points.unweighted(), None, False
        for limit in self._limits(kappa):
            found = fit_rational(phi, psi, limit, points)
            values = phi @ found.numerator / (1.0 + psi @ found.denominator)[:, None]
            at = values, found.rank * q + psi.shape[1]
            self._judge(points, *at)
            exact = alike.misfit(values) <= _EXACT * values.size
            explained = noise_explains(self) or points.whitening is None and exact
            if self.weighted_ and plausible is None:
                plausible = found, at
            if explained or not found.bound:
                break
        if plausible is not None and not explained:
            found, at = plausible
            self._judge(points, *at)
        elif not explained:
            found = fit_rational(phi, psi, next(self._limits(kappa)), alike)
        self.numerator_, self.rank_ = found.numerator, found.rank
        self.denominator_ = np.concatenate([[1.0], found.denominator])

    def _evaluate(self, kappa: Array) -> Array:
        numerator = self._terms(kappa, self.powers_) @ self.numerator_
        below = self._terms(kappa, self.denominator_powers_) @ self.denominator_
        return numerator / below[:, None]

    def _coefficients(self) -> Array:
        return np.concatenate([self.numerator_.ravel(), self.denominator_[1:]])

    def _set(self, coefficients: Array) -> None:
        numerator, d = np.split(coefficients, [self.numerator_.size])
        *_, widest = self._limits(self.scheduling_range_)
        if not widest.allows(d):
            raise ValueError(
                "`coefficients` must keep the denominator positive within the range "
                f"of the points, {widest.least:.1g} of its largest value at least. Got "
                f"{d.tolist()} beside its constant 1."
            )
        self.numerator_ = numerator.reshape(self.numerator_.shape)
        self.denominator_ = np.concatenate([[1.0], d])

    def _limits(self, kappa: Array) -> Iterator[_Limit]:
        """What the denominator must keep: less where with that none is plausible."""
        for margin, least in _LIMITS:
            yield self._limit(kappa, margin, least)
        near, far = np.sort(np.abs(self.scheduling_range_), axis=0)
        signed = (np.prod(self.scheduling_range_, axis=0) > 0.0) & (near < far)
        way = np.full(len(near), np.inf)
        np.divide(_TO_ZERO * near, far - near, out=way, where=signed)
        if (way < margin).any():
            degree = self.denominator_powers_.sum(axis=1).max()
            share = _TO_ZERO * _TO_ZERO * np.min((near / far)[way < margin])
            yield self._limit(kappa, np.minimum(way, margin), min(least, share**degree))

    def _limit(self, kappa: Array, margin: float | Array, least: float) -> _Limit:
        """Where the denominator must not vanish, and how small it may be there."""
        places = _places(self.scheduling_range_, kappa, margin)
        ends = (places == places.min(axis=0)) | (places == places.max(axis=0))
        psi = self._terms(places, self.denominator_powers_)[:, 1:]
        return _Limit(psi, ends.any(axis=1), least)

    def _carried(self, outer: Array, kappa: Array) -> Array:
        psi = self._terms(kappa, self.denominator_powers_)
        below = (psi @ self.denominator_)[:, None]
        phi = self._terms(kappa, self.powers_) / below
        lowered = -(outer @ (phi @ self.numerator_ / below)[:, :, None])
        parts = [carried_by_terms(outer, phi), lowered * psi[:, None, 1:]]
        return np.concatenate(parts, axis=2)

    def _terms(self, kappa: Array, powers: NDArray[np.intp]) -> Array:
        return chebyshev_terms(kappa, powers, self.scheduling_range_)

    def _check_options(self) -> None:
        super()._check_options()
        whole_number("degree", self.degree, 0)
        whole_number("denominator", self.denominator, 0)
        one_of("terms", self.terms, _TERMS)


class Rational(NamedTuple):
    """Coefficients of a rational function."""

    numerator: Array  # (n_terms, n_params)
    denominator: Array  # (n_denominator_terms - 1,), without the constant 1
    rank: int  # of the terms of a numerator
    bound: bool  # whether the limit held the search back: else a wider one changes none


class _Limit(NamedTuple):
    """What a denominator must keep."""

    places: Array  # (n_places, n_denominator_terms - 1): its terms but for its constant
    border: NDArray[np.bool_]  # (n_places,)
    least: float  # of its largest value at all of these

    def allows(self, d: Array) -> bool:
        """Whether a denominator, without its constant 1, stays so large.

        Small it may be towards an end, as the square of a length is; not in between.
        """
        below = 1.0 + self.places @ d
        share = below.min() / below.max() if below.max() > 0.0 else -1.0
        at_end = self.border[np.argmin(below)]
        return bool(share >= (self.least if at_end else _LEAST))  # False of NaN


def fit_rational(
    phi: Array, psi: Array, limit: _Limit, points: WeightedPoints
) -> Rational:
    """The least misfit among functions without a pole.

    Terms of the numerators (n_points, n_terms), and of the denominator but for its
    constant (n_points, n_denominator_terms - 1), which keeps a limit.
    """
    d, bound = _Search(orth(phi), psi, limit, points).least()
    numerator, rank = points.coefficients(phi / (1.0 + psi @ d)[:, None])
    return Rational(numerator, d, rank, bound)


class _State(NamedTuple):
    """What a denominator leaves."""

    errors: Array
    slopes: Array  # derivatives of the errors (Kaufman's approximation)


class _Search(NamedTuple):
    """The search for the denominator."""

    phi: Array  # independent terms of the numerators
    psi: Array
    limit: _Limit
    points: WeightedPoints

    def starts(self) -> list[Array]:
        """Denominators: none, and the one of Sanathanan and Koerner."""
        none = np.zeros(self.psi.shape[1])
        return [none, self._sanathanan_koerner()] if none.size else [none]

    def _sanathanan_koerner(self) -> Array:
        """Minimise ``sum_i |(N^T phi_i - theta_i (1 + d^T psi_i)) / old_i|^2``."""
        d: Array = np.zeros(self.psi.shape[1])
        with np.errstate(all="ignore"):
            for _ in range(_MAX_ITERATIONS):
                old = (1.0 + self.psi @ d)[:, None]
                if not (np.isfinite(old).all() and old.all()):
                    break
                theta = self.points.theta / old
                basis = np.linalg.qr(self.points.design(self.phi / old))[0]
                columns = [theta, *(theta * column[:, None] for column in self.psi.T)]
                rest = self._unexplained(basis, columns)
                last = d
                solution = np.linalg.lstsq(rest[:, 1:], -rest[:, 0], rcond=None)[0]
                d = np.array(solution, dtype=np.float64)
                if np.abs(d - last).max() <= _SAME * np.abs(d).max(initial=1.0):
                    break
        return d

    def _unexplained(self, basis: Array, values: list[Array]) -> Array:
        """What is orthogonal to a basis in values (n_points, n_params), as columns."""
        rows = np.array([self.points.errors(value) for value in values])
        return (rows - basis @ (basis.T @ rows)).reshape(len(values), -1).T

    def _at(self, d: Array) -> _State:
        below = (1.0 + self.psi @ d)[:, None]
        terms = self.phi / below
        basis, R = np.linalg.qr(self.points.design(terms))
        target = self.points.errors(self.points.theta)
        errors = (basis @ (basis.T @ target) - target).ravel()
        numerator = solve_triangular(R, basis.T @ target).reshape(terms.shape[1], -1)
        if self.points.whitening is None:
            numerator = numerator * self.points.scale
        fitted = terms @ numerator
        columns = [-fitted * column[:, None] / below for column in self.psi.T]
        none = np.zeros((errors.size, 0))
        slopes = self._unexplained(basis, columns) if columns else none
        return _State(errors, slopes)

    def least(self) -> tuple[Array, bool]:
        """The denominator of the least misfit, and whether the limit refused others.

        Without its constant.
        """
        none, bound = np.full(self.points.theta.size, np.inf), False
        refused = _State(none, np.zeros((len(none), self.psi.shape[1])))

        def state(d: Array) -> _State:
            nonlocal bound
            if self.limit.allows(d):
                return self._at(d)
            bound = True
            return refused

        def residuals(trial: Array, rows: NDArray[np.intp]) -> tuple[Array, Any]:
            states = [state(d) for d in trial]
            errors = np.array([state.errors for state in states])
            return errors, lambda kept: np.array([states[k].slopes for k in kept])

        found = levenberg_marquardt(
            residuals,
            np.array(self.starts()),
            max_iter=_MAX_ITERATIONS,
            tol=_SAME,
            patience=1,
        )
        return found.x[np.argmin(found.cost)], bound


def _places(scheduling_range: Array, kappa: Array, margin: float | Array) -> Array:
    """Where the denominator must not vanish: the range and its margin, as a grid."""
    n = kappa.shape[1]
    levels = int(_PLACES ** (1 / n) + 1e-9)
    if levels < 2:
        return kappa
    low, high = scheduling_range
    beyond = margin * (high - low)
    axes = np.linspace(low - beyond, high + beyond, levels).T
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n)
