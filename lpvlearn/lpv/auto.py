"""The choice of the form that carries parameters over the scheduling variables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..models.scheduling_range import in_range_of_points
from ..validation import one_of
from .interpolator import Interpolator
from .left_out import inner_levels, inner_places, interpolated_without
from .polynomial import PolynomialLPV, chebyshev_terms, resolvable_powers
from .rational import RationalLPV
from .spline import SplineLPV
from .weighting import WeightedPoints, is_chance, noise_explains

Array = NDArray[np.float64]

_CRITERIA = ("aic", "bic")

# Degrees of numerators and denominator, the simplest first: higher ones swing.
_DEGREES = (
    *((degree, 0) for degree in range(5)),
    *((1, 1), (1, 2), (2, 1), (2, 2), (3, 2), (3, 3)),
)
_SATURATED = 2  # the highest degree whose coefficients the points may just determine
_TENSOR = 2  # the highest degree in every variable: more takes minutes

# Forms whose criterion is higher than the lowest by more than this have no support
# (Burnham and Anderson 2002, section 2.6). Without it one in three of AIC's choices
# would have coefficients too many.
_SUPPORT = 10.0

# A rational form, or a polynomial of a high degree, that has coefficients for more than
# this share of the values meets most points: it must foresee those left out as well.
_FREE = 0.5
_BETTER = 1.0 - 1e-6  # of the squared errors of points left out: no equals, to rounding
_NOISE = 10.0  # standard deviations over which a parameter moves by more than noise

# Chi-square of straight parameters whose bends one pole explains: of 540 random
# parabolas, which meet three points whatever these are, none looked like a pole by it.
_SURE = 1e3

# Where no form is true: the first, or one of the others that meets points left out, so
# many at least, with less than this share of its squared errors, over the parameters.
_CURVES = (("pchip", "linear"), ("cubic", "linear"), ("pchip", "log"), ("cubic", "log"))
_SMOOTHER, _LEFT_OUT = 0.7, 3
# Fewer variables, of so many at most, where errors are below this share without others.
_WITHOUT, _FEW_VARIABLES = 0.3, 3
_JOINT = 1e-3  # least singular value, in the range of the points, of ones on no line
_FAR_LESS = 1e-3  # share of the errors below which a parameter says no more
# Mean squared error, in the spread, of what must not be met worse; but for this share.
_FORESEEN, _FEW = 0.02, 0.1


class _Choice(NamedTuple):
    """One of several forms."""

    place: int | None  # None where none is plausible
    proven: bool  # or it must foresee points left out
    cost: Array  # the criterion of all forms


class AutoLPV(Interpolator):
    """Interpolation by the form that the covariances of the parameters speak for.

    A sample is an operating point: `X` holds its scheduling values, `y` the parameters
    of its local model.

    With the covariances of the parameters, polynomials and rational functions compete.
    Out are those whose errors cannot be chance, and those whose criterion is more than
    10 above the lowest. Of what is left a polynomial of degree 2 at most (in each of
    several variables: 1) is taken, and else the one with fewest coefficients.

    Where none is left, or covariances are not known, the interpolation goes through
    the points (`SplineLPV`) and keeps their shape. A cubic spline, or a curve over the
    logarithms of the scheduling variables, takes its place if it meets points that are
    left out, three at least, with clearly smaller errors (in the geometric mean over
    the parameters).

    Of two or three scheduling variables fewer are tried where no form of all is proven:
    what depends on one alone is foreseen better with that one.

    Parameters
    ----------
    criterion : {"aic", "bic"}, default="aic"
        ``chi2 + 2 k`` or ``chi2 + k log(n)``, with k coefficients for n values.
    extrapolation : {"ignore", "warn", "clip", "error"}, default="ignore"
        What `predict` does outside of `scheduling_range_`: go on without or with an
        `ExtrapolationWarning`, hold the value at the border, or raise.

    Attributes
    ----------
    selection_ : DataFrame
        A row for every form: "form", "chi2" (its least distance from the points,
        squared, in units of their covariances), "dof" (degrees of freedom), "aic" (or
        "bic"), and "chosen". NaN where covariances are not known.
    form_ : str
        The form chosen.
    best_estimator_ : PolynomialLPV, RationalLPV or SplineLPV
        The form, fitted.
    scheduling_range_ : ndarray of shape (2, n_scheduling)
    n_features_in_ : int
        Number of scheduling variables.

    Notes
    -----
    A rational form, or a polynomial of a higher degree than these, with more than half
    as many coefficients as there are values must foresee points that are left out,
    within the range of the others, as well as interpolation does; a rational form
    better. A polynomial that meets any points, as a parabola does three, gives way to
    a pole where all that moves (two parameters at least) is proportional to the inverse
    of a straight line, as what is divided by one mass or length is.

    If a form is true, its chi-square is about its degrees of freedom. A form whose
    chi-square is more than four times that (and no chance, for few degrees of freedom)
    is not taken, unless what it leaves of the variation over the points is next to
    nothing (1e-4 of the variance): very precise points show deviations of any form. If
    only such forms are left, the lowest of their chi-squares per degree of freedom
    divides all chi-squares in the criterion, as errors larger than known do.

    Rational forms have one denominator: the entries of ``M(kappa)^-1 K(kappa)``, of any
    equation of motion, are such functions. With several scheduling variables
    polynomials and rational forms of a total degree compete with those of a degree in
    each variable ("tensor").

    References
    ----------
    K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference. Springer,
    2002: a difference of 10 in the criterion leaves a form without support.

    Examples
    --------
    Spring constants with their standard deviations, 0.01:

    >>> import numpy as np
    >>> from lpvlearn import AutoLPV
    >>> kappa = np.linspace(0, 2, 6)[:, None]
    >>> noise = 0.01 * np.array([1.0, -0.4, 0.3, -1.1, 0.5, 0.2])
    >>> stiffness = 4 + 3 * kappa[:, 0] ** 2 + noise
    >>> model = AutoLPV().fit(kappa, stiffness, covariance=np.full(6, 1e-4))
    >>> model.form_
    'polynomial 2'
    >>> model.selection_.round(1).head(4)
               form       chi2  dof        aic  chosen
    0  polynomial 0  1093953.1    5  1093955.1   False
    1  polynomial 1    86601.0    4    86605.0   False
    2  polynomial 2        1.6    3        7.6    True
    3  polynomial 3        1.5    2        9.5   False
    """

    def __init__(
        self, criterion: str = "aic", *, extrapolation: str = "ignore"
    ) -> None:
        self.criterion = criterion
        self.extrapolation = extrapolation

    def _fit(self, kappa: Array, points: WeightedPoints) -> None:
        found: list[tuple[str, Any]] = []
        known = points.whitening is not None
        for fewer in (False, True):
            for name, form in _forms(kappa, fewer) if known else ():
                form.fit(kappa, points.theta, points.root**2, points.covariance)
                saturated = form.degrees_of_freedom_ <= 0  # it meets any points
                if isinstance(form, PolynomialLPV) or not saturated:
                    found.append((name, form))
            place, proven, cost = self._most_supported(found, kappa, points)
            if proven:
                break
        if not proven:
            name, curve = _interpolation(kappa, points)
            if place is None or not _foresees(found[place][1], curve, kappa, points):
                place, cost = len(found), np.append(cost, np.nan)
                found.append((name, curve.fit(kappa, points.theta, points.root**2)))
        assert place is not None
        self.form_, self.best_estimator_ = found[place]
        self.selection_ = pd.DataFrame(
            {
                "form": [name for name, _ in found],
                "chi2": [getattr(form, "chi2_", np.nan) for _, form in found],
                "dof": [getattr(form, "degrees_of_freedom_", 0) for _, form in found],
                self.criterion: cost,
                "chosen": np.arange(len(found)) == place,
            }
        )

    def _most_supported(
        self, found: Sequence[tuple[str, Any]], kappa: Array, points: WeightedPoints
    ) -> _Choice:
        """What the covariances speak for."""
        chi2 = np.array([form.chi2_ for _, form in found])
        dof = np.array([form.degrees_of_freedom_ for _, form in found], dtype=int)
        good = np.array([form.weighted_ for _, form in found], dtype=bool)
        excess = 1.0
        if not any(map(is_chance, chi2, dof)) and good.any():
            excess = np.min(chi2[good] / dof[good])
        n = points.theta.size
        price = 2.0 if self.criterion == "aic" else math.log(n)
        cost = chi2 / excess + price * (n - dof)
        if not good.any():
            return _Choice(None, False, cost)
        near = good & (cost <= cost[good].min() + _SUPPORT)
        supported = np.flatnonzero(near).tolist()
        # few points tell a parabola from a pole poorly: then it is the parabola
        bent = [not _is_parabola(form) for _, form in found]
        chosen = min(supported, key=lambda k: (bent[k], -dof[k], cost[k]))
        followed = _values_of(found[chosen][1].variables, kappa)
        n_places = len(np.unique(followed, axis=0))
        meets_any = n - dof[chosen] >= n_places * points.theta.shape[1]
        if meets_any:  # a common pole would not
            poles = [
                k for k in supported if _has_shown_pole(found[k], found, kappa, points)
            ]
            if poles:
                return _Choice(min(poles, key=lambda k: cost[k]), True, cost)
        free = bent[chosen] and n - dof[chosen] > _FREE * n
        surface = meets_any and np.count_nonzero(np.ptp(followed, axis=0)) > 1
        return _Choice(chosen, not (free or surface), cost)

    def replaced(self, name: str, form: Interpolator) -> AutoLPV:
        """A copy that takes another form, on other evidence than the points'."""
        other = copy(self)
        other.form_, other.best_estimator_ = name, form
        rows = self.selection_.assign(chosen=False)
        rows.loc[len(rows), ["form", "dof", "chosen"]] = name, 0, True
        other.selection_ = rows.astype(self.selection_.dtypes)
        return other

    def _evaluate(self, kappa: Array) -> Array:
        return self.best_estimator_._evaluate(kappa)

    def _coefficients(self) -> Array:
        return self.best_estimator_._coefficients()

    def _set(self, coefficients: Array) -> None:
        self.best_estimator_ = self.best_estimator_.with_coefficients(coefficients)

    def _carried(self, outer: Array, kappa: Array) -> Array:
        return self.best_estimator_._carried(outer, kappa)

    def _excess(self) -> float:
        return self.best_estimator_._excess()

    def _check_options(self) -> None:
        super()._check_options()
        one_of("criterion", self.criterion, _CRITERIA)


def _is_parabola(form: PolynomialLPV | RationalLPV) -> bool:
    """Whether a form has no pole, and no terms of a higher degree than a parabola.

    As a tensor of degree 2 has in several variables, and swings by them.
    """
    if isinstance(form, PolynomialLPV):
        return form.degree <= _SATURATED
    return form.denominator == 0 and form.degree < _TENSOR


def _has_shown_pole(
    own: tuple[str, Any],
    found: Sequence[tuple[str, Any]],
    kappa: Array,
    points: WeightedPoints,
) -> bool:
    """Whether one pole explains how parameters bend, far beyond their noise.

    Those that follow one function of any shape have one, as far as few points tell. But
    that what moves is all proportional, to the inverse of a line, is no chance.
    """
    form, moving = own[1], np.flatnonzero(_moving(points))
    if getattr(form, "denominator", 0) != 1 or points.covariance is None:
        return False
    if len(moving) < 2:  # of three values of one a line is found too easily
        return False
    straight = next(
        other
        for _, other in found
        if isinstance(other, PolynomialLPV)
        and (other.degree, other.variables) == (form.degree, form.variables)
    )
    if not (straight.chi2_ > _SURE and noise_explains(form)):
        return False
    P = points.covariance[:, moving[:, None], moving]
    inverse = RationalLPV(0, 1, variables=form.variables)
    return noise_explains(inverse.fit(kappa, points.theta[:, moving], None, P))


def _moving(points: WeightedPoints) -> NDArray[np.bool_]:
    """Which parameters move, by more than their noise where that is known."""
    spread = np.ptp(points.theta, axis=0)
    if points.whitening is None or points.covariance is None:
        return spread > 0.0
    variance = np.diagonal(points.covariance, axis1=1, axis2=2)
    known = np.isfinite(variance)
    total = np.sum(np.where(known, variance, 0.0), axis=0)
    return np.asarray(spread > _NOISE * np.sqrt(total / np.maximum(known.sum(0), 1)))


def _foresees(
    form: Any, curve: SplineLPV, kappa: Array, points: WeightedPoints
) -> bool:
    """Whether points left out are met as well as by a curve through the others.

    Better, of a form with a denominator: through few points it may be the cubic that a
    spline is, and that tells nothing of what it is through all. Where the others are
    too few for it, whether no curve over fewer variables does.
    """
    errors = _errors_left_out([form, curve], kappa, points, kappa)
    if errors.shape[1] == 0:
        return curve.variables is None or form.variables is not None
    own, other = errors.sum(axis=(1, 2))
    return bool(own <= (_BETTER if getattr(form, "denominator", 0) else 1.0) * other)


def _interpolation(kappa: Array, points: WeightedPoints) -> tuple[str, SplineLPV]:
    """Name and kind of the curve through all points, not fitted."""
    best: list[tuple[str, SplineLPV]] = []
    for variables, suffix in _choices_of_variables(kappa):
        followed, curves = _values_of(variables, kappa), list(best)
        for kind, scale in _CURVES:
            if scale == "linear" or (followed > 0.0).all():
                prefix = "" if scale == "linear" else f"{scale} "
                curve = SplineLPV(kind, scale=scale, variables=variables)
                curves.append((f"{prefix}{kind}{suffix}", curve))
        # over fewer variables points are met by chance more easily
        enough = _SMOOTHER if variables is None else _WITHOUT
        best = [curves[_foreseeing(curves, followed, kappa, points, enough)]]
    return best[0]


def _foreseeing(
    named: Sequence[tuple[str, SplineLPV]],
    followed: Array,
    kappa: Array,
    points: WeightedPoints,
    enough: float,
) -> int:
    """Which curve meets points left out with less than that share of the first's error.

    The first, where none does, or too few points are within the range of the others.
    """
    curves = [curve for _, curve in named]
    errors = _errors_left_out(curves, kappa, points, followed)
    if errors.shape[1] < _LEFT_OUT or not errors[0].any():
        return 0
    # of every parameter, relative to the first, and their geometric mean: noise of some
    # hides no law of others
    each = errors.sum(axis=1)
    ratios = each[:, each[0] > 0.0] / each[0, each[0] > 0.0]
    shares = np.exp(np.mean(np.log(np.maximum(ratios, _FAR_LESS)), axis=1))
    seen = each[0] < _FORESEEN * errors.shape[1]
    worse = np.sum(each[:, seen] > _FORESEEN * errors.shape[1], axis=1)
    shares[worse > _FEW * np.count_nonzero(seen)] = np.inf
    # logarithms that are nearly straight tell none; and by those that do, both curves
    # foresee more: the smooth one alone meets a few points by chance
    own = shares.copy()
    for k, curve in enumerate(curves):
        if curve.scale == "log" and k > 1:
            chance = curve.kind == "cubic" and own[k - 1] >= own[k - 3]
            if chance or own[k] >= _SMOOTHER * own[k - 2]:
                shares[k] = np.inf
    best = int(np.argmin(shares))
    return best if shares[best] < enough else 0


def _errors_left_out(
    forms: Sequence[Any], kappa: Array, points: WeightedPoints, followed: Array
) -> Array:
    """Squared errors at points left out, (n_forms, n_left_out, n_moving).

    Those within the range of the others, by what is `followed`, in the spread of every
    parameter that moves, and by more than its noise where that is known. And on a grid
    all points of a level, next to which others of the same level tell what only they do
    not.
    """
    theta, spread = points.theta, np.ptp(points.theta, axis=0)
    covariance = points.covariance if points.whitening is not None else None
    moves = _moving(points)
    squares: list[Array] = []
    for out in (*inner_places(followed), *inner_levels(followed)):
        foreseen = [
            interpolated_without(out, form, kappa, theta, kappa[out], covariance)
            for form in forms
        ]
        known = [values for values in foreseen if values is not None]
        if len(known) == len(forms):  # else the others are too few
            errors = np.array(known) - theta[out]
            squares.append(np.sum((errors[..., moves] / spread[moves]) ** 2, axis=1))
    shape = len(squares), len(forms), int(np.count_nonzero(moves))
    return np.reshape(squares, shape).swapaxes(0, 1)


def _choices_of_variables(kappa: Array) -> Iterator[tuple[list[int] | None, str]]:
    """All scheduling variables, and of two or three that vary fewer, with a suffix.

    Of points that lie on a line nothing tells which one they follow.
    """
    yield None, ""
    varies = np.flatnonzero(np.ptp(kappa, axis=0)).tolist()
    x = in_range_of_points(kappa)[:, varies]
    joint = np.linalg.matrix_rank(x - x.mean(axis=0), _JOINT) < len(varies)
    if len(varies) <= _FEW_VARIABLES and not joint:
        for n in range(len(varies) - 1, 0, -1):
            for some in combinations(varies, n):
                yield list(some), f" of variable {' and '.join(map(str, some))}"


def _values_of(variables: Sequence[int] | None, kappa: Array) -> Array:
    """The scheduling values that a form follows."""
    return kappa if variables is None else kappa[:, variables]


def _forms(
    kappa: Array, fewer: bool
) -> Iterator[tuple[str, PolynomialLPV | RationalLPV]]:
    """Name and form of all whose numerators the points determine.

    They follow all variables, or fewer; but for a constant, which follows none.
    """
    for variables, suffix in _choices_of_variables(kappa):
        if fewer == (variables is not None):
            for name, form in _forms_of_all(_values_of(variables, kappa)):
                if not fewer or form.degree:
                    yield f"{name}{suffix}", form.set_params(variables=variables)


def _forms_of_all(kappa: Array) -> Iterator[tuple[str, PolynomialLPV | RationalLPV]]:
    """Those that follow all variables."""
    places = np.unique(kappa, axis=0)
    n, n_variables = len(places), max(int(np.count_nonzero(np.ptp(places, axis=0))), 1)
    for kind in ("total", "tensor")[:n_variables]:
        tensor = kind == "tensor"
        prefix = "tensor " if tensor else ""
        for degree, below in _DEGREES:
            n_terms = (
                (degree + 1) ** n_variables
                if tensor
                else math.comb(degree + n_variables, degree)
            )
            if tensor and degree > _TENSOR:
                continue
            if n_terms > n or (n_terms == n and degree > _SATURATED):
                continue
            powers = resolvable_powers(degree, places, tensor=tensor)
            ends = np.array([places.min(axis=0), places.max(axis=0)])
            terms = chebyshev_terms(places, powers, ends)
            if np.linalg.matrix_rank(terms) < len(powers):
                continue
            if below:
                yield (
                    f"{prefix}rational {degree}/{below}",
                    RationalLPV(degree, below, terms=kind),
                )
            elif not tensor:
                yield f"polynomial {degree}", PolynomialLPV(degree)
            elif degree:
                yield f"tensor polynomial {degree}", RationalLPV(degree, 0, terms=kind)
