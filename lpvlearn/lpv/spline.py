"""Interpolation that meets every operating point, without a form for all of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import (
    CubicSpline,
    PchipInterpolator,
    RBFInterpolator,
    make_interp_spline,
)

from ..validation import one_of
from .interpolator import Interpolator, to_unit
from .weighting import WeightedPoints

Array = NDArray[np.float64]

_KINDS = ("pchip", "cubic", "linear")


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
        cube (the others), with every variable mapped to [-1, 1].
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

    def __init__(self, kind: str = "pchip", *, extrapolation: str = "ignore") -> None:
        self.kind = kind
        self.extrapolation = extrapolation

    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        x, place = np.unique(
            to_unit(kappa, self.scheduling_range_), axis=0, return_inverse=True
        )
        weight = np.zeros((len(x), len(kappa)))
        weight[place.ravel(), np.arange(len(kappa))] = points.root**2
        theta = weight @ points.theta / weight.sum(axis=1, keepdims=True)
        self.n_points_, n = x.shape
        if n == 1 and len(x) > 1:
            curves = {
                "pchip": PchipInterpolator,
                "cubic": CubicSpline,
                "linear": lambda x, y: make_interp_spline(x, y, k=1),
            }
            self._curve = curves[self.kind](x[:, 0], theta)
            self._slope = self._curve.derivative()
            return
        # a cubic needs points that determine a plane beside it
        plane = np.linalg.matrix_rank(np.column_stack([np.ones(len(x)), x])) > n
        kernel = "cubic" if plane and self.kind != "linear" else "linear"
        self._curve = RBFInterpolator(x, theta, kernel=kernel)
        self._slope = None

    def _evaluate(self, kappa: Array) -> Array:
        x = to_unit(kappa, self.scheduling_range_)
        if self._slope is None:
            return np.asarray(self._curve(x))
        inside = np.clip(x, -1.0, 1.0)
        return self._curve(inside[:, 0]) + (x - inside) * self._slope(inside[:, 0])

    def _check_options(self) -> None:
        super()._check_options()
        one_of("kind", self.kind, _KINDS)
