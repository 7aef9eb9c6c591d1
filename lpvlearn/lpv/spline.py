"""Interpolation that meets every operating point, without a form for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import (
    CubicHermiteSpline,
    CubicSpline,
    PchipInterpolator,
    RBFInterpolator,
    make_interp_spline,
)

from ..models.scheduling_range import to_unit
from ..validation import one_of
from .interpolator import Interpolator, carried_by_terms
from .weighting import WeightedPoints

Array = NDArray[np.float64]

_KINDS = ("pchip", "cubic", "linear")
_SCALES = ("linear", "log")


class SplineLPV(Interpolator):
    """Interpolation through the parameters of local models, piece by piece.

    A sample is an operating point: `X` holds its scheduling values, `y` the parameters
    of its local model. Points at one place count as their mean.

    Parameters
    ----------
    kind : {"pchip", "cubic", "linear"}, default="pchip"
        With one scheduling variable: cubic pieces that keep the shape (monotone between
        two points wherever the points are), a cubic spline (smoother, and nearer to
        smooth precise parameters, but it may swing), or straight lines. With several,
        on scattered points: radial basis functions, of the distance ("linear") or its
        cube (the others), with every variable mapped to [-1, 1]. One that takes a
        single value does not count.
    scale : {"linear", "log"}, default="linear"
        What the curve is laid over: the scheduling variables, or their logarithms,
        where all are above zero: lengths, masses, speeds that range over a factor of
        two and more, of which powers are near to straight there.
    variables : sequence of int, default=None
        Places of the scheduling variables that the parameters follow; None: all.
    extrapolation : {"ignore", "warn", "clip", "error"}, default="ignore"
        What `predict` does outside of `scheduling_range_`: go on (with one variable,
        along the tangent at the border) without or with an `ExtrapolationWarning`, hold
        the value at the border, or raise.

    Attributes
    ----------
    scheduling_range_ : ndarray of shape (2, n_scheduling)
    n_points_ : int
        Number of distinct points.
    n_features_in_ : int
        Number of scheduling variables.

    Notes
    -----
    The curve meets every point, with its noise; covariances are of no use to it. Where
    the form of the parameters is known, `PolynomialLPV` and `RationalLPV` are more
    precise.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import SplineLPV
    >>> kappa = np.array([[0.0], [1.0], [2.0], [3.0]])
    >>> theta = [0.0, 0.0, 1.0, 1.0]
    >>> SplineLPV().fit(kappa, theta).predict([[0.5], [1.5], [2.5]])
    array([0. , 0.5, 1. ])
    """

    def __init__(
        self,
        kind: str = "pchip",
        *,
        scale: str = "linear",
        variables: Sequence[int] | None = None,
        extrapolation: str = "ignore",
    ) -> None:
        self.kind = kind
        self.scale = scale
        self.variables = variables
        self.extrapolation = extrapolation

    def __getstate__(self) -> dict[str, Any]:
        # The curve is of a class that not every format holds.
        return {k: v for k, v in super().__getstate__().items() if k != "_curve"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if hasattr(self, "_theta"):
            self._draw(self._theta)

    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        if self.scale == "log" and not (kappa[:, self._follows()] > 0.0).all():
            raise ValueError(
                "`scale` must be 'linear' where a scheduling variable is not above "
                f"zero. Got 'log', and {kappa.min():.4g}."
            )
        x, place = np.unique(self._unit(kappa), axis=0, return_inverse=True)
        weight = np.zeros((len(x), len(kappa)))
        weight[place.ravel(), np.arange(len(kappa))] = points.root**2
        theta = weight @ points.theta / weight.sum(axis=1, keepdims=True)
        self.n_points_, self._nodes = len(x), x
        self._draw(theta)

    def _draw(self, theta: Array) -> None:
        """Lay the curve through values (n_points, n_params) at the nodes."""
        self._theta = theta
        self._curve = self._through(theta)

    def _through(self, theta: Array) -> Any:
        x = self._varying(self._nodes)
        n = x.shape[1]
        if n > 1 or len(x) == 1:
            # a cubic needs points that determine a plane beside it
            plane = np.linalg.matrix_rank(np.column_stack([np.ones(len(x)), x])) > n
            kernel = "cubic" if plane and self.kind != "linear" else "linear"
            return RBFInterpolator(x, theta, kernel=kernel)
        curves = {
            "pchip": PchipInterpolator,
            "cubic": CubicSpline,
            "linear": lambda x, y: make_interp_spline(x, y, k=1),
        }
        return curves[self.kind](x[:, 0], theta)

    def _evaluate(self, kappa: Array) -> Array:
        return _along(self._curve, self._varying(self._unit(kappa)))

    def _varying(self, x: Array) -> Array:
        """The variables that take more than one value; one at least."""
        varies = (np.ptp(self.scheduling_range_, axis=0) > 0.0) & self._follows()
        return x[:, varies] if varies.any() else x[:, :1]

    def _unit(self, kappa: Array) -> Array:
        """Where scheduling values lie from -1 to 1; beyond, along the tangent there."""
        if self.scale == "linear":
            return to_unit(kappa, self.scheduling_range_)
        follows = self._follows()  # the others may be below zero
        scheduling_range = np.where(follows, self.scheduling_range_, 1.0)
        inside = np.clip(kappa, *scheduling_range)
        beyond = np.where(follows, kappa - inside, 0.0) / inside
        return to_unit(np.log(inside) + beyond, np.log(scheduling_range))

    def _coefficients(self) -> Array:
        return self._theta.ravel()

    def _set(self, coefficients: Array) -> None:
        self._draw(coefficients.reshape(self._theta.shape))

    def _carried(self, outer: Array, kappa: Array) -> Array:
        x, (n, q) = self._varying(self._unit(kappa)), self._theta.shape
        if isinstance(self._curve, PchipInterpolator):  # its slopes follow the values
            nodes = self._varying(self._nodes)[:, 0]
            units = np.eye(n)[:, :, None].repeat(q, axis=2)
            changes = _pchip_slope_changes(nodes, self._theta)
            curve = CubicHermiteSpline(nodes, units, changes)
        else:
            curve = self._through(np.eye(n))
        return carried_by_terms(outer, _along(curve, x))

    def _check_options(self) -> None:
        super()._check_options()
        one_of("kind", self.kind, _KINDS)
        one_of("scale", self.scale, _SCALES)


def _along(curve: Any, x: Array) -> Array:
    """Values of a curve; one of one variable goes on along its tangents at the ends."""
    if isinstance(curve, RBFInterpolator):
        return np.asarray(curve(x))
    inside = np.clip(x[:, 0], -1.0, 1.0)
    values = curve(inside)
    further = (x[:, 0] - inside).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values + further * curve.derivative()(inside))


def _pchip_slope_changes(x: Array, theta: Array) -> Array:
    """Derivatives of the slopes at nodes by the values, (n_nodes, n_nodes, n_params).

    Fritsch and Butland's: zero where the secants on both sides differ in sign, else
    their weighted harmonic mean; at the ends that of a parabola through three points,
    zero or three times the secant where this one has another sign or is too steep.
    """
    h = np.diff(x)[:, None]
    secants = np.diff(theta, axis=0) / h
    n, q = theta.shape
    by_secant = np.zeros((n, n - 1, q))  # derivatives of the slopes by the secants
    if n == 2:
        by_secant[:] = 1.0
    else:
        before, after = secants[:-1], secants[1:]
        inner, k = np.arange(1, n - 1), np.arange(n - 2)
        alike = before * after > 0
        w = np.stack([2 * h[1:] + h[:-1], h[1:] + 2 * h[:-1]])
        w = w / w.sum(axis=0)
        m = np.where(alike, [before, after], 1.0)
        mean = 1.0 / (w / m).sum(axis=0)
        by_secant[inner, k], by_secant[inner, k + 1] = w * (mean / m) ** 2 * alike
        for node, first, second in ((0, 0, 1), (n - 1, n - 2, n - 3)):
            share = h[first] / (h[first] + h[second])
            slope = (1 + share) * secants[first] - share * secants[second]
            turns = slope * secants[first] <= 0
            steep = (secants[first] * secants[second] < 0) & (
                np.abs(slope) > 3 * np.abs(secants[first])
            )
            by_secant[node, first] = np.where(steep, 3.0, 1 + share) * ~turns
            by_secant[node, second] = np.where(steep, 0.0, -share) * ~turns
    changes = np.zeros((n, n, q))
    changes[:, 1:] += by_secant / h
    changes[:, :-1] -= by_secant / h
    return changes
