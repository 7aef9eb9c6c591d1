"""Least squares over operating points, weighed by the covariances of their values.

With ``R_i^T R_i = P_i^-1``, P_i the covariance of the values theta_i at point i, the
coefficients N of known terms f_i minimise ``sum_i |R_i (theta_i - N^T f_i)|^2``: if the
terms can describe the values, the minimum is a chi-square.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2 as chi_square

from ..systems.least_squares import diagonal_scale
from ..validation import real_array, squarable

Array = NDArray[np.float64]

# A standard deviation below this share of the parameter's size is not believed: the
# search for the local parameters does not go on beyond it.
_RESOLUTION = 1e-7

_OPEN = 1e6  # standard deviation of a parameter that is not determined, in its sizes

_ROUNDING = 1e-13  # of parameters that are zero, relative to the largest one

_LEAST = 1e-150  # deviations below have no squares

_SINGULAR = 1e-12  # eigenvalue of a correlation matrix that is zero up to rounding

# Per degree of freedom: the covariances are those of local models to first order. (The
# arm at 30 dB, 7 and 4 points, 10 seeds: its form 0.4 to 1.8, others above 1000.)
_PLAUSIBLE = 4.0

# Share of the values' variance over the points (per degree of freedom) that is no
# matter, however precise they are: 1 % of their spread. (The arm averaged over 20
# realizations: its form 1e-5, for the local models are of a non-linear system; a
# polynomial of degree 4 2e-3.)
_NEGLIGIBLE = 1e-4

_NO_DIRECTION = 1e-12  # of a covariance, relative to its largest: rounding

_SURPRISE = 1e-3  # probability of a chi-square, of few degrees of freedom, that is one


@dataclass(frozen=True)
class WeightedPoints:
    """Values at operating points, and how much each of them counts."""

    theta: Array  # (n_points, n_params)
    root: Array  # (n_points,), square roots of the weights of the points
    scale: Array  # (n_params,), sizes by which values without covariance are compared
    covariance: Array | None  # (n_points, n_params, n_params): P_i, as given
    whitening: Array | None  # R_i; None: not known, or not of all points

    def unweighted(self) -> WeightedPoints:
        """The same points without what is known of their covariances."""
        return replace(self, whitening=None)

    def errors(self, values: Array) -> Array:
        """Values (n_points, n_params) as rows of the least-squares problem."""
        if self.whitening is None:
            return values * self.root[:, None] / self.scale
        return (self.whitening @ (self.root[:, None] * values)[:, :, None]).reshape(
            -1, 1
        )

    def design(self, terms: Array) -> Array:
        """The matrix from coefficients to rows, of terms (n_points, n_terms)."""
        rooted = self.root[:, None] * terms
        if self.whitening is None:
            return rooted
        rows = self.whitening[:, :, None, :] * rooted[:, None, :, None]
        return rows.reshape(self.theta.size, -1)

    def coefficients(self, terms: Array) -> tuple[Array, int]:
        """Coefficients (n_terms, n_params) of minimum norm; the rank of the terms."""
        rows, target = self.design(terms), self.errors(self.theta)
        if self.whitening is None:
            solution, _, rank, _ = np.linalg.lstsq(rows, target, rcond=None)
            return solution * self.scale, int(rank)
        size = np.linalg.norm(rows, axis=0)
        size = np.where(size > 0, size, 1.0)
        solution = np.linalg.lstsq(rows / size, target, rcond=None)[0][:, 0] / size
        rank = np.linalg.matrix_rank(self.root[:, None] * terms)
        return solution.reshape(terms.shape[1], -1), int(rank)

    def misfit(self, values: Array) -> float:
        """Weighted sum of squares of what `values` leave; with covariances, chi^2."""
        return float(np.sum(self.errors(self.theta - values) ** 2))

    def is_plausible(self, chi2: float, degrees_of_freedom: int) -> bool:
        """Whether a form that leaves `chi2` may be taken for true, or as good as it."""
        if is_chance(chi2, degrees_of_freedom):
            return True
        one = np.ones((len(self.theta), 1))
        constant = self.misfit(one @ self.coefficients(one)[0])
        spread = constant / max(self.theta.size - self.theta.shape[1], 1)
        return bool(chi2 <= _NEGLIGIBLE * spread * degrees_of_freedom)


def weighted_points(
    theta: Array, weight: Array, covariance: ArrayLike | None
) -> WeightedPoints:
    """Points with weights (n_points,) and covariances (n_points, n_params, n_params).

    Weights count beside each other, whatever their mean. Points of weight zero are left
    out, and so are parameters of an infinite variance. Where a covariance is not known
    (NaN) or singular, none is used.
    """
    used = weight > 0
    P = None
    if covariance is not None:
        P = squarable("covariance", real_array("covariance", covariance))
        n, q = theta.shape
        if P.shape == (n,) and q == 1:
            P = P[:, None, None]
        if P.shape != (n, q, q):
            raise ValueError(
                f"`covariance` must have shape {(n, q, q)}: a matrix for the "
                f"parameters of each operating point. Got {P.shape}."
            )
        P = P[used]
    theta, share = theta[used], weight[used] / weight[used].mean()
    middle = np.average(theta, axis=0, weights=share)
    spread = np.sqrt(np.average((theta - middle) ** 2, axis=0, weights=share))
    size = np.abs(theta).max(axis=0)
    size = np.where(size > np.finfo(float).tiny, size, 1.0)
    scale = np.where(spread > _RESOLUTION * size, spread, size)
    whitening = None if P is None else _whitening(P, size)
    return WeightedPoints(theta, np.sqrt(share), scale, P, whitening)


def _whitening(P: Array, size: Array) -> Array | None:
    """``R_i`` of every point; None if one is not known. `size` of the parameters."""
    variance = np.diagonal(P, axis1=1, axis2=2)
    if np.isnan(P).any() or (variance < 0).any():
        return None
    # an infinite variance, of a parameter that its point does not determine: no weight;
    # one that none determines is a choice, kept as it is
    open_ = np.isinf(variance)
    P = np.where(open_[:, :, None] | open_[:, None, :], 0.0, P)
    here = open_ & ~open_.all(axis=0)
    P = P + np.where(here, (_OPEN * size) ** 2, 0.0)[:, :, None] * np.eye(len(size))
    if not np.isfinite(P).all():  # of finite variances: no covariance
        return None
    variance = np.diagonal(P, axis1=1, axis2=2)
    least = _RESOLUTION * size
    if np.median(np.sqrt(variance) / size) < _RESOLUTION:  # no noise, but rounding
        least = np.maximum(least, _ROUNDING * size.max())
    deviation = np.sqrt(variance + least**2)
    P = P + np.diag(least**2)
    if not deviation.min() > _LEAST:
        return None
    correlation = P / deviation[:, :, None] / deviation[:, None, :]
    if np.linalg.eigvalsh(correlation).min() < _SINGULAR:
        return None
    return np.linalg.inv(np.linalg.cholesky(correlation)) / deviation[:, None, :]


def is_chance(chi2: float, degrees_of_freedom: int) -> bool:
    """Whether errors may be those of the values, not of the form through them."""
    if degrees_of_freedom == 0:  # the form meets the points, whatever they are
        return True
    surprise = chi_square.isf(_SURPRISE, degrees_of_freedom)
    return bool(chi2 <= max(_PLAUSIBLE * degrees_of_freedom, surprise))


def noise_explains(form: Any) -> bool:
    """Whether a fitted form misses its points by their noise; a curve misses none."""
    dof = getattr(form, "degrees_of_freedom_", 0)
    return dof > 0 and is_chance(getattr(form, "chi2_", np.nan), dof)


def covariance_of(information: Array) -> Array:
    """Inverse of an information matrix, whatever the units of its coefficients.

    Directions that nothing is known of count as known (minimum norm).
    """
    size = diagonal_scale(information)
    scaled = information / size[:, None] / size
    inverse = np.linalg.pinv(scaled, hermitian=True)
    return np.asarray(inverse / size[:, None] / size)


def covariance_factor(covariance: Array) -> Array:
    """F of as few columns as a covariance has directions, ``F F^T`` the covariance."""
    size = diagonal_scale(covariance)
    values, vectors = np.linalg.eigh(covariance / size[:, None] / size)
    kept = values > _NO_DIRECTION * values.max(initial=0.0)
    return np.asarray(size[:, None] * vectors[:, kept] * np.sqrt(values[kept]))
