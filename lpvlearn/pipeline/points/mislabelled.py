"""Operating points where a channel has another unit, sign or place than elsewhere.

That leaves its mark on a response: a constant ratio to what the other points foresee.
And points that have the scheduling values of one another, or one in another unit, which
parameters tell.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...exceptions import warn
from ...lpv.left_out import inner_places
from ...lpv.polynomial import PolynomialLPV
from ...lpv.weighting import noise_explains
from ...models.scheduling_range import in_range_of_points
from ...models.statespace import forgetting
from ..running.runner import place_of
from .left_out import forgotten
from .local_models import LocalModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Frequencies, from below the slowest pole to above the fastest by that factor, and the
# part of the largest gain of a channel from which its response counts there.
_N_FREQUENCIES, _BEYOND, _KNOWN = 100, 3.0, 0.05

# Misfit of two responses, |G - R| / (|G| + |R|), of that part of the frequencies: up to
# which they are alike, and the share of it that is left of a point when it is mended.
_PART, _ALIKE, _LEFT = 0.7, 0.35, 0.4

# A factor that is no law of the scheduling: so many times beyond what the other points
# range over, which are not much themselves where it is a sign.
_FAR, _RANGE = 5.0, 10.0

_OTHERS = 3  # points that tell how much a channel varies

# Degrees of a polynomial that meets parameters within their noise where two points, of
# that many at most, are exchanged; and times its chi-square, at the least, as they are.
_DEGREES, _MANY, _CLEARER = (1, 2), 15, 100.0

# Units that are taken for one another: the first is so many times the second, and more
_UNITS = (
    (("degrees Fahrenheit", "Celsius"), 1.8, 32.0),
    (("kelvin", "degrees Celsius"), 1.0, 273.15),
    (("degrees", "radians"), 180.0 / np.pi, 0.0),
    (("radians", "turns"), 2.0 * np.pi, 0.0),
    (("turns a minute", "radians a second"), 30.0 / np.pi, 0.0),
    (("seconds", "minutes"), 60.0, 0.0),
    (("km/h", "m/s"), 3.6, 0.0),
    (("feet", "metres"), 1.0 / 0.3048, 0.0),
    (("knots", "m/s"), 3600.0 / 1852.0, 0.0),
    (("tenths", "ones"), 10.0, 0.0),
    (("percent", "ones"), 100.0, 0.0),
    (("thousandths", "ones"), 1e3, 0.0),
    (("millionths", "ones"), 1e6, 0.0),
)

_BEYOND_OTHERS = 0.5  # of the range of the others, at which a point may be an end

_ROUND = 1.25  # from a power of ten, up to which a factor is told as that


class _Mended(NamedTuple):
    """What makes of the model at a point what the others foresee; the best first."""

    n_channels: int
    left: float  # the share of the misfit
    message: str


def tell_of_mislabelled(
    local: Sequence[LocalModel],
    kappa: Array,
    longest: float,
    inputs: Sequence[Hashable],
    outputs: Sequence[Hashable],
) -> bool:
    """Warn of a point with channels in another unit, reversed, or exchanged.

    Only where three or more others agree on what there is to be, whatever law they
    follow, and where the mended response is that. Of the point of which that is
    clearest: its neighbours may look odd beside it. What hardly decays in the `longest`
    record (seconds) is forgotten.
    """
    if len(local) <= _OTHERS:
        return False
    labels = [f"output {name!r}" for name in outputs], [f"input {u!r}" for u in inputs]
    if len(inputs) == len(outputs) == 1:  # nothing tells them apart
        labels = ([f"{labels[0][0]} (or {labels[1][0]})"],) * 2
    G = _responses(local, longest)
    found = [_mended(G, kappa, k, labels) for k in range(len(G))]
    told = [one for one in found if one is not None]
    if told:
        best = min(told, key=lambda one: one.left)
        warn(
            f"{best.message}. What else is told of the points may follow from that. "
            "Give the record as the others are, or leave the point out, and fit again."
        )
    return bool(told)


def tell_of_wrong_values(
    kappa: Array, theta: Array, covariance: Array, names: Sequence[Hashable]
) -> bool:
    """Warn of two points with the values of one another, or one in another unit.

    Where parameters `theta`, (n_points, n_params), of these `covariance` are met by a
    low polynomial within their noise with the values of the scheduling variables, of
    these `names`, as they are to be then, far better than as they are, and in no other
    way. And of a point without which those of the others are. Whether one was told.
    """
    n = len(kappa)
    if n > _MANY or not np.isfinite(covariance).all():
        return False

    def forms(places: Array, of: Any = slice(None)) -> list[PolynomialLPV]:
        found = []
        for degree in _DEGREES:
            with suppress(ValueError):  # the points are too few
                form = PolynomialLPV(degree)
                fitted = form.fit(places[of], theta[of], covariance=covariance[of])
                found.append(fitted)
        # two values beside the coefficients of every parameter
        return [f for f in found if f.degrees_of_freedom_ >= 2 * theta.shape[1]]

    as_is = forms(kappa)
    if not as_is or any(map(noise_explains, as_is)):
        return False
    most = min(form.chi2_ for form in as_is) / _CLEARER
    found: dict[tuple[int, int | None], tuple[float, str]] = {}
    for where, places, message in _other_values(kappa, names):
        fits = [f.chi2_ for f in forms(places) if noise_explains(f) and f.chi2_ < most]
        if fits and min(fits) < found.get(where, (np.inf,))[0]:
            found[where] = min(fits), message
    if len(found) == 1:
        ((_, message),) = found.values()
        warn(
            f"{message}: all parameters follow a simple law within their standard "
            "deviations then, and as they stand by far not. Give the values as they "
            "are to be there, and fit again."
        )
        return True
    odd = [  # within the range of the others: at its end laws may end
        int(out.argmax())
        for out in inner_places(kappa)
        if any(noise_explains(f) and f.chi2_ < most for f in forms(kappa, ~out))
    ]
    if len(odd) == 1:
        warn(
            f"{place_of(odd[0], kappa)} is unlike the others, whose parameters follow "
            "a simple law within their standard deviations, and with it by far not; "
            "the LPV model goes through it all the same. Check its record (gains of "
            "sensors and units, `report_`) and its scheduling value, or leave it out."
        )
    return len(odd) == 1


def _other_values(
    kappa: Array, names: Sequence[Hashable]
) -> Iterator[tuple[tuple[int, int | None], Array, str]]:
    """Points, the scheduling values as they may be meant, and what would be wrong.

    Two points, or one that is far beyond all others, and among them in another unit.
    """
    for i, j in combinations(range(len(kappa)), 2):
        places = kappa.copy()
        places[[i, j]] = kappa[[j, i]]
        first, second = place_of(i, kappa), place_of(j, kappa)
        message = (
            f"the records of {first} and {second} look exchanged, with the scheduling "
            "values of one another"
        )
        yield (i, j), places, message
    for k, (j, name) in product(range(len(kappa)), enumerate(names)):
        value, others = kappa[k, j], np.delete(kappa[:, j], k)
        beyond = _BEYOND_OTHERS * np.ptp(others)
        low, high = others.min() - beyond, others.max() + beyond
        for said, factor, less in () if low <= value <= high else _UNITS:
            for back in (True, False):
                meant = (value - less) / factor if back else factor * value + less
                if low <= meant <= high:
                    places = kappa.copy()
                    places[k, j] = meant
                    unit = " in place of ".join(said if back else said[::-1])
                    message = (
                        f"{place_of(k, kappa)} looks to have {name!r} in another unit "
                        f"than the others ({unit}: {meant:.4g} for {value:.4g})"
                    )
                    yield (k, None), places, message


def _responses(local: Sequence[LocalModel], longest: float) -> Complex:
    """Responses of the points, (n_points, n_freq, n_outputs, n_inputs)."""
    models = [(one.own or one).lti.with_input_delay(0) for one in local]
    rate = forgotten(models, longest)
    models = [forgetting(model, rate) for model in models]
    speeds = np.abs(np.concatenate([model.poles() for model in models]))
    speeds = speeds[speeds > 0.0] if speeds.any() else np.ones(1)
    ends = speeds.min() / _BEYOND, speeds.max() * _BEYOND
    omega = np.geomspace(*ends, _N_FREQUENCIES)
    with np.errstate(all="ignore"):
        G = np.array([model.frequency_response(omega) for model in models])
    return np.where(np.isfinite(G), G, 0.0)


def _mended(
    G: Complex, kappa: Array, k: int, labels: Sequence[Sequence[str]]
) -> _Mended | None:
    """What would make of the model at point k what the others foresee.

    The factors of outputs, or of inputs, far from all that a law through the others
    may have there; or two channels in one another's places.
    """
    others = np.delete(np.arange(len(G)), k)
    ways, size, place = _ways(kappa, others, k), _size(G[others]), place_of(k, kappa)
    own, rest = G[k] / size, G[others] / size
    nearest = np.argsort(np.linalg.norm(ways[0], axis=1), kind="stable")
    ahead = [_foreseen(rest, ways[0], degree) for degree in (1, 2)]
    foreseen = [*rest[nearest[:2]], *ahead]
    found: list[_Mended] = []
    for R, axis in product(foreseen, (1, 2)):
        names = [f"{name} at {place}" for name in labels[axis - 1]]
        found += _rescaled(own, R, rest, rest[nearest[0]], ways, axis, names)
        found += _exchanged(own, R, rest, size, axis, labels[axis - 1], place)
    if not found:
        return None
    as_is = min(_misfit(own, R) for R in (*rest, *foreseen))
    found = [one for one in found if one.left < _LEFT * as_is]
    best = min(found, default=None)
    return None if best is None else best._replace(left=best.left / as_is)


def _rescaled(
    own: Complex,
    R: Complex,
    rest: Complex,
    nearest: Complex,
    ways: Sequence[Array],
    axis: int,
    names: Sequence[str],
) -> Iterator[_Mended]:
    """With other factors of the channels of an axis, if these are no law."""
    factors, beside = (_gains(one, R, axis) for one in (own, nearest))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(factors / beside)
    # all of a law is wider than one of its points: the others need not be asked
    far = (ratio > _FAR) | (ratio < 1.0 / _FAR) | (factors < 0.0)
    if not far.any():
        return
    usual = np.array([_gains(one, R, axis) for one in rest])
    wrong = [
        i
        for i in np.flatnonzero(far).tolist()
        if _is_no_law(factors[i], usual[:, i], ways)
    ]
    if not wrong:
        return
    used = np.ones(len(factors))
    used[wrong] = factors[wrong]
    left = _misfit(own, R * np.expand_dims(used, 2 - axis))
    if left < _ALIKE:
        factors = factors / _foreseen(usual, ways[0], 1)
        faults = [f"{names[i]} {_fault(factors[i])}" for i in wrong]
        yield _Mended(len(wrong), left, "; ".join(faults))


def _exchanged(
    own: Complex,
    R: Complex,
    rest: Complex,
    size: Array,
    axis: int,
    names: Sequence[str],
    place: str,
) -> Iterator[_Mended]:
    """With two channels of an axis in one another's places, if no other point is so."""
    n = own.shape[axis]
    for i, j in combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        turned: Complex = np.take(R * size, order, axis) / size
        left = _misfit(own, turned)
        if left < _ALIKE and all(_misfit(x, R) < _misfit(x, turned) for x in rest):
            yield _Mended(
                2,
                left,
                f"{names[i]} and {names[j]} at {place} look exchanged, by what the "
                "other points foresee: check which is which there",
            )


def _fault(factor: float) -> str:
    """What is wrong of a channel, by its gain in that of the others: sign, or unit."""
    size = max(abs(factor), 1.0 / abs(factor))
    if size < _FAR and factor < 0.0:
        return (
            "has the reverse sign of what the other points foresee: check its wiring "
            "and its sign there"
        )
    tens = float(10.0 ** np.round(np.log10(size)))
    size = tens if max(size / tens, tens / size) < _ROUND else float(f"{size:.2g}")
    times = f"{size:.12g} times" if abs(factor) > 1.0 else f"1/{size:.12g} of"
    reverse = "in reverse " if factor < 0.0 else ""
    return (
        f"acts {reverse}as about {times} what the other points foresee: check its unit "
        "there"
    )


def _ways(kappa: Array, others: NDArray[np.intp], k: int) -> list[Array]:
    """How far the others are from a point: by the scheduling, and by its ratios."""
    ways = [kappa, np.log(kappa)] if (kappa > 0.0).all() else [kappa]
    return [x[others] - x[k] for x in map(in_range_of_points, ways)]


def _foreseen(values: NDArray[Any], away: Array, degree: int) -> NDArray[Any]:
    """At the point that others are `away` from, by a polynomial of the nearest."""
    n = 1 + degree * away.shape[1]
    near = np.argsort(np.linalg.norm(away, axis=1), kind="stable")[:n]
    x = away[near]
    powers = np.hstack([np.ones((len(x), 1)), *(x**p for p in range(1, degree + 1))])
    flat = values[near].reshape(len(x), -1)
    constant: NDArray[Any] = np.linalg.lstsq(powers, flat, rcond=None)[0][0]
    return constant.reshape(values.shape[1:])


def _is_no_law(factor: float, usual: Array, ways: Sequence[Array]) -> bool:
    """Whether a gain is none that a law of the scheduling may have beside the others.

    Of these none may be near to zero, or of another sign, nor what a law comes to. A
    gain may change its sign towards an end of their range, not within it and back.
    """
    inside = ((ways[0] <= 0.0).any(axis=0) & (ways[0] >= 0.0).any(axis=0)).all()
    if factor == 0.0 or not (usual > 0.0).all() or (factor < 0.0 and not inside):
        return False
    with np.errstate(over="ignore"):  # of a law that comes to anything there
        laws = [
            law
            for way, degree in product(ways, (1, 2))
            for law in (
                _foreseen(usual, way, degree),
                np.exp(_foreseen(np.log(usual), way, degree)),
            )
        ]
    low, high = (float(end([*usual, *laws])) for end in (min, max))
    if low <= 0.0:
        return False
    size, wide = abs(factor), high / low
    far = max(size / high, low / size) > _FAR * wide
    return far or (factor < 0.0 and wide < _RANGE)


def _gains(G: Complex, R: Complex, axis: int) -> Array:
    """Of every channel of a response, how many times it is that of another."""
    size, error = (np.abs(M).sum(axis=3 - axis) for M in (G, R))
    turn = np.real(G * R.conj()).sum(axis=3 - axis)
    found = np.zeros(size.shape[1])
    for i, (own, other, way) in enumerate(zip(size.T, error.T, turn.T, strict=True)):
        known = (own > _KNOWN * own.max()) & (other > _KNOWN * other.max())
        if known.any():
            ratio = np.exp(np.median(np.log(own[known] / other[known])))
            found[i] = np.sign(np.median(way[known])) * ratio
    return found


def _misfit(G: Complex, R: Complex) -> float:
    """How unlike two responses are, from 0 to 1: in the worst of their channels."""
    worst = 0.0
    for axis in (1, 2):
        size = (np.abs(G) + np.abs(R)).sum(axis=axis)
        error = np.abs(G - R).sum(axis=axis)
        for whole, part in zip(size.T, error.T, strict=True):
            known = whole > _KNOWN * whole.max()
            if known.any():
                relative = part[known] / whole[known]
                worst = max(worst, float(np.quantile(relative, _PART)))
    return worst


def _size(G: Complex) -> Array:
    """That of the channels (n_outputs, n_inputs): of outputs times that of inputs."""
    size = np.median(np.sqrt(np.mean(np.abs(G) ** 2, axis=1)), axis=0)
    found = np.ones_like(size)
    for axis in (1, 0):
        part = np.sqrt(np.mean((size / found) ** 2, axis=axis, keepdims=True))
        found = found * np.where(part > 0.0, part, 1.0)
    return found
