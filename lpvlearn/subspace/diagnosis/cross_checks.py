"""What is wrong with samples, as fits of other or changed ones show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...data.faulty_signals import far_out
from ...data.preparation import DETRENDS
from ...systems.simulation import delayed, lti_response
from ...validation import listed
from ..fits.delay import first_samples, longest_delays
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples, TooFewSamples
from ..simulation_error.held_out import DOUBT, HeldOut
from ..simulation_error.simulation_fit import simulation_errors, with_initial_states
from ..telling import in_experiment

Array = NDArray[np.float64]

_NAMED = 5  # experiments that a message lists

_ROUGH = 0.1  # share of the outputs' size, left by a model, that is looked into

# Experiments contradict one another where models of each leave less than this share of
# the squared errors of the one for all.
_CONTRADICTED = 0.25

_MOST_ALONE = 6  # experiments, the longest, of which that is looked into
_VALUES_EACH = 10  # of their outputs for each parameter, at least

# Share of an experiment's squared outputs, left by a model, that it has no part in.
_FOREIGN = 0.5

# Share of the error that is left without samples of inputs that are not answered.
_ANSWERED = 0.6

# A delay is told that is long, or saves states: less costs next to nothing.
_LATE = 3  # samples of it, at least
_FEWER = 2  # states in its place, at least

# An impulse response may be that of a delay which comes to half its height
_RISEN = 4  # times the delay after the impulse, at the latest
_EARLY = 0.25  # of its height: below it until half of the delay is over
_WHOLE = 20  # times the delay, in which its height is looked for


def tell_of_contradiction(samples: Samples, whole: LocalFit) -> None:
    """Tell of experiments that one model cannot explain, and models of each do."""
    pairs, choices, telling = samples
    same = samples._replace(choices=whole.chosen(choices)).aside("collinear")
    free = whole.evidence.free
    records, model = whole.scaled.records, whole.evidence.model
    if len(pairs) < 2 or not whole.residual > _ROUGH or "contradiction" in telling:
        return
    if whole.method == "pbsid" or choices.estimated or len(records) != len(pairs):
        return
    n_values = model.C.size + model.B.size + np.count_nonzero(free.direct)
    least = _VALUES_EACH * (n_values + len(model.A))
    lengths = np.array([record.y.size for record in records])
    some = [
        k
        for k in np.argsort(-lengths)[:_MOST_ALONE]
        if lengths[k] >= least and np.ptp(pairs[k][0], axis=0).all()  # inputs move
    ]
    found = simulation_errors(with_initial_states(model, records, free), records)
    if _tell_of_foreign(samples, same, whole, found):
        return
    energies = []
    for k in some:
        other = same._replace(pairs=[pairs[k]]).tried(free.n_trend, whole)
        if other is None:
            continue
        size = np.sum(records[k].y ** 2)
        energies.append([np.sum(found[k] ** 2), _left_by(other, whole), size])
    if len(energies) < 2:
        return
    together, apart, size = np.sum(energies, axis=0)
    if apart < _CONTRADICTED * together:
        left, alone = 100.0 * np.sqrt([together / size, apart / size])
        telling.once(
            "contradiction",
            "The experiments contradict one another: of their outputs one model leaves "
            f"{left:.2g} %, models of each alone leave {max(alone, 0.01):.2g} %. The "
            "system was not the same in them (a load, a setting, the sign of a "
            "sensor), or it is not linear. Check them, give what differs as a "
            "scheduling variable, or leave out those that do not belong here.",
        )


def _tell_of_foreign(
    samples: Samples, same: Samples, whole: LocalFit, found: Sequence[Array]
) -> bool:
    """Tell of experiments without which a model of the others explains these.

    The `same` samples, by the choices of the whole; `found` are the errors of that.
    """
    records = whole.scaled.records
    left = np.array([np.sum(e**2) for e in found])
    size = np.array([np.sum(record.y**2) for record in records])
    # Levels of their own are none of another system.
    moved = [np.sum((e - e.mean(axis=0)) ** 2) for e in found]
    motion = [np.sum((r.y.T - r.y.T.mean(axis=0)) ** 2) for r in records]
    foreign = np.array(moved) > _FOREIGN * np.array(motion)
    rest = np.flatnonzero(~foreign)
    if not (foreign.any() and len(rest)):
        return False
    others = same._replace(pairs=[samples.pairs[k] for k in rest])
    other = others.tried(whole.evidence.free.n_trend)
    if other is None:
        return False
    alone = _left_by(other, whole)
    if not alone < _CONTRADICTED * left[rest].sum():
        return False
    names = [str(k) for k in np.flatnonzero(foreign)]
    shares = 100.0 * np.sqrt([alone, left[rest].sum()] / size[rest].sum())
    samples.telling.once(
        "contradiction",
        f"Experiment(s) {listed(names, _NAMED)}, counted "
        "from 0, do not belong to the others: of the outputs of these a model leaves "
        f"{shares[0]:.2g} % without them, {shares[1]:.2g} % with them. Check them for "
        "channels that were exchanged, unplugged or of another sign, or for another "
        "setting of the system, and leave them out.",
    )
    return True


def _left_by(other: LocalFit, whole: LocalFit) -> float:
    """Squared errors of another model on its own records, in the units of the whole."""
    scale = other.evidence.output_scale / whole.evidence.output_scale
    errors = simulation_errors(other.evidence.model, other.scaled.records)
    return float(sum(np.sum((e * scale) ** 2) for e in errors))


def tell_of_input_spikes(samples: Samples, whole: LocalFit) -> None:
    """Tell of single samples of an input that the outputs do not answer."""
    pairs, choices, telling = samples
    if not whole.residual > _ROUGH or "input spikes" in telling:
        return
    without, found = [], []
    for k, (u, y) in enumerate(pairs):
        spikes = far_out(u)
        u = u.copy()
        for i, j in np.argwhere(spikes):
            u[i, j] = 0.5 * (u[i - 1, j] + u[i + 1, j])
            found.append((j, k, i))
        without.append((u, y))
    if not found:
        return
    same = Samples(without, whole.chosen(choices), telling.aside())
    other = same.tried(whole.evidence.free.n_trend)
    if other is not None and other.residual < _ANSWERED * whole.residual:
        j, k, i = found[0]
        where = f"sample {in_experiment(i, k, len(pairs))}"
        telling.once(
            "input spikes",
            f"{len(found)} sample(s) of the inputs stand far out, and the outputs do "
            f"not answer them; the first is {where} of input {telling.input(j)}, "
            "counted from 0. With what their neighbours have in their place a model "
            f"leaves {100.0 * other.residual:.2g} % of the outputs, not "
            f"{100.0 * whole.residual:.2g} %. If they were logged wrongly, replace "
            "them by NaN and use missing='split', or by what was sent.",
        )


def tell_of_delay(samples: Samples, whole: LocalFit) -> None:
    """Tell of inputs that arrive late, where no delay was asked for.

    Each sample of a delay takes a state, or blurs the response. The first answer that
    is certain may come later than the input arrives: with that much delay a model must
    simulate parts held out clearly better, or no worse with fewer states.
    """
    pairs, choices, telling = samples
    if whole.method == "pbsid" or choices.estimated or "delay" in telling:
        return
    pairs = first_samples(pairs)
    channels = pairs[0][1].shape[1], pairs[0][0].shape[1]
    direct = np.broadcast_to(choices.feedthrough, channels)
    delay = longest_delays(pairs, np.any(direct, axis=0))
    cut = int(delay.max())
    # A model that lacks something tells nothing of how the plant begins to answer.
    if cut < _LATE or not ("lack" in telling or _answers_late(whole, cut)):
        return
    n_trend = whole.evidence.free.n_trend
    aside = samples.aside()
    given = aside.having(method=whole.method, offset=DETRENDS[n_trend])
    known = slice(cut if choices.initial_states else 0, None)  # from rest, all are
    pairs = [(u, y) for u, y in pairs if len(u) > cut + 1]
    late = [(delayed(u, delay)[known], y[known]) for u, y in pairs]
    early = [(u[known], y[known]) for u, y in pairs]
    same = aside._replace(choices=whole.chosen(choices))
    order = whole.selection.order

    def with_errors(some: Samples, like: LocalFit | None = None) -> tuple[int, HeldOut]:
        """Order, and errors on parts held out."""
        other = some.fit(n_trend, like)
        return other.selection.order, given.errors_held_out(other)

    try:
        own = with_errors(same._replace(pairs=early), whole)
        # a choice among all orders takes many times as long as one of these
        fewer = order - _FEWER if choices.order is None else 0
        same = same._replace(pairs=late)
        some = (same.having(order=n) for n in (order, fewer) if n > 0)
        if not any(_gain(own, with_errors(one)) for one in some):
            return
        other = with_errors(given._replace(pairs=late))
    except TooFewSamples:
        return
    gained, fits = _gain(own, other), (other[1].bft, own[1].bft)
    if not gained:
        return
    if gained == "states":
        what = f"does as well on parts held out as this one of order {order}"
    else:
        what = f"simulates {fits[0]:.3g} % of parts held out, this one {fits[1]:.3g} %"
    shown = [
        f"input {telling.input(j)} only after {delay[j]} samples"
        for j in np.flatnonzero(delay >= _LATE)
    ]
    telling.once(
        "delay",
        f"Beyond noise, the outputs show {', '.join(shown)}; it may arrive a few "
        f"sooner. With a delay in place of them a model of order {other[0]} {what}. "
        "Try input_delay='auto', which takes what is a delay beyond doubt, or give as "
        f"many samples or fewer (input_delay={delay.tolist()}), and compare on another "
        "record.",
    )


def _gain(own: tuple[int, HeldOut], other: tuple[int, HeldOut]) -> str:
    """What another model has of a delay: fewer "states", less "errors", or ""."""
    (order, error), (another, found) = own, other
    if [p.error.shape for p in error.parts] != [p.error.shape for p in found.parts]:
        return ""  # late inputs move in other parts
    if order - another >= _FEWER and not error.clearly_better_than(found, 0.0):
        return "states"
    return "errors" if found.clearly_better_than(error, DOUBT) else ""


def _answers_late(fitted: LocalFit, delay: int) -> bool:
    """Whether the impulse response of a model may be that of a delay.

    Of a slow system the first samples are as small, beside what comes later.
    """
    A, B, C, D = fitted.model[:4]
    impulse = np.zeros((_WHOLE * delay + 1, 1))
    impulse[0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        heights = np.column_stack(
            [
                np.abs(lti_response(A, B[:, [j]], C, D[:, [j]], impulse)).max(axis=1)
                for j in range(B.shape[1])
            ]
        )
    if not np.isfinite(heights).all():
        return False
    heights = heights / np.maximum(heights.max(axis=0), np.finfo(float).tiny)
    late = (heights[: delay // 2 + 1] < _EARLY).all(axis=0)
    return bool((late & (heights[: _RISEN * delay] > 0.5).any(axis=0)).any())
