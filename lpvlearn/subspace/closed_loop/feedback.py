"""What the inputs know about the noise: tests of feedback.

What the regression of `varx` leaves is white, and in open loop independent of all
inputs; under feedback the inputs that follow know it (Sims, 1972; Caines and Chan,
1975). Past inputs and outputs are regressors already, so that a missing state, coloured
noise or coloured inputs raise no alarm: all that is asked of p is to be long enough,
which the data choose. Where a few kicks are most of what the past does not foresee of
an input, the samples that none of them follows are asked as well: inputs alone choose
these.

Within the sample, what the past does not foresee of inputs and outputs, a and b, may
depend on each other because inputs act at once, ``b = D a + w`` with w independent of
a, or because a controller answers at once, ``a = L b + r`` with r independent of b.
Covariances are the same either way. Of signals that are not Gaussian only one of the
two has errors that are independent of what they are errors beside (Shimizu, Hoyer,
Hyvarinen and Kerminen, 2006); those of the other depend on nonlinear functions of it.
References that are steps, held or binary are far from Gaussian. Of several inputs that
is asked of each, beside whatever the others do: some may act at once, others answer.
There inputs that are measured, rounded or limited look alike too often to be taken for
a loop: it is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from ...systems.least_squares import scaled_lstsq
from ..samples.records import Record
from .varx import (
    DEPENDENT,
    FORESEEN,
    MAX_ROWS,
    N_FUTURE,
    NO_INNOVATION,
    Past,
    Regression,
    basis_of,
    coefficients_of,
    samples_of,
)

Array = NDArray[np.float64]

# p-value of what is called feedback, also where the past is cut off (of 1,165 records
# in open loop one came to 5e-13), and lags of the nonlinear terms that may be it
_LEVEL, _BEYOND_DOUBT, _N_CURVED = 1e-4, 1e-20, 3

# p-values below which something acts within the sample, and may be an answer
_INSTANTANEOUS, _AT_ONCE = 0.01, 1e-3

# p-values above which inputs answer, if below them outputs do not answer inputs; root
# mean squares from which the cubes of the nonlinear terms grow no more; moves that a
# channel must have, as the fourth power of its size counts them: a few may be no moves;
# share of what the past does not foresee that the sample before does
_LIKELY, _REFUTED, _CLIPPED, _SEVERAL, _FOLLOWS = 0.01, 1e-8, 5.0, 8.0, 0.2

# An innovation stands out where it is so many times the median magnitude (4 standard
# deviations of Gaussian noise), and beyond most others of its output
_OUTLYING, _MOST = 6.0, 0.95

# Share of what the past does not explain of an input, beyond which what stands out of
# it (the kicks of a derivative at steps of a reference) hides what noise does there;
# share of the samples at which an input moves beside such kicks; share of the
# innovations that these must tell: an input may follow what a past of some samples
# lacks (of 480 records in open loop up to .09)
_HIDES, _ANSWERS, _MUCH = 0.5, 0.3, 0.1

_LITTLE = 0.2  # share of what the next inputs tell, of what those after these add

# Innovations, relative to the outputs, too small to do harm or to be told from rounding
_NOISE_FREE = 1e-5


class Feedback(NamedTuple):
    """What the inputs know about the noise."""

    p_value: float  # of innovations and future inputs that do not correlate
    share: float  # of the innovations that future inputs explain, beyond chance
    p_instantaneous: float  # of ``u[t]`` and ``y[t]`` not correlated, given the past
    curved: float  # share that nonlinear terms of the past explain
    innovations: Array  # (n_outputs,), their variances
    cut_off: bool = False  # whether the samples carry no longer past than they chose
    regression: Regression | None = None  # of outputs on inputs and the past
    foreseen: bool = False  # whether every input follows from the past and the outputs
    p_direct: float = 1.0  # of outputs on a straight line over inputs of the sample
    p_answer: float = 1.0  # of inputs on a straight line over outputs of the sample
    alone: bool = True  # whether there is a single input
    soon: bool = False  # whether the inputs of the next sample tell nearly all of it

    @property
    def found(self) -> bool:
        """Whether there is feedback."""
        return self.shown or self.answered

    @property
    def shown(self) -> bool:
        """Whether future inputs show it.

        Errors of a nonlinearity know future inputs, too, where these follow from
        the past nonlinearly (chirps, values that are held); but they follow from
        the past themselves, which noise does not. Of what acted before a past that is
        cut off, future inputs may tell that follow the same past.
        """
        level = _BEYOND_DOUBT if self.cut_off else _LEVEL
        return self.p_value < level and self.share > self.curved

    @property
    def answered(self) -> bool:
        """Whether the only input answers outputs within the sample.

        Of several others may act at once, and what one seems to answer is no proof.
        """
        return self.alone and self.may_be_answered

    @property
    def may_be_answered(self) -> bool:
        """Whether an input answers outputs within the sample, which do not answer it.

        As a controller makes it do. In open loop noise of a measured input does, too.
        """
        line = self.p_direct < _REFUTED and self.p_answer > _LIKELY
        return line and self.p_instantaneous < _AT_ONCE and not self.cut_off

    @property
    def acts_at_once(self) -> bool:
        """Whether an input surely acts within the sample, and answers no output."""
        return self.foreseen or (self.p_answer < _REFUTED and self.p_direct > _LIKELY)

    @property
    def instantaneous(self) -> bool:
        """Whether an output knows an input of the same sample: or the other way."""
        return self.p_instantaneous < _INSTANTANEOUS


def find_feedback(records: Sequence[Record]) -> Feedback | None:
    """Test of feedback; None where the samples are too few.

    Every channel may have a constant of its own in every experiment.

    Canonical correlations of the innovations with future inputs, given present and past
    ones and past outputs, by Bartlett's approximation of Wilks' criterion.
    """
    whole = Past.of(records, N_FUTURE)
    if whole is None:
        return None
    m, ny = len(whole.records[0].u), len(whole.records[0].y)
    c, past, rows = m + ny, whole.needed, whole.present
    cut_off = past == whole.longest and past * c < MAX_ROWS - N_FUTURE * m
    u, y, future = np.split(rows[:, past * c :], [m, c])
    dof = whole.n_windows - past * c
    within = _wilks(y, basis_of(u, rows[:m], FORESEEN), dof)
    seen = basis_of(y, rows[m:c], DEPENDENT)
    foreseen = not basis_of(u - (u @ seen) @ seen.T, rows[:m], FORESEEN).size
    present = basis_of(u, rows[:m], DEPENDENT)
    y, future = (x - (x @ present) @ present.T for x in (y, future))
    noisy = np.linalg.norm(y, axis=1) > _NOISE_FREE * np.linalg.norm(rows[m:c], axis=1)
    dof -= m
    found, curved = _wilks(y[noisy], basis_of(future, rows[c:], FORESEEN), dof), 0.0
    windows, calm = _windows_of(whole.records, past), None
    if found.p_value >= _LEVEL:
        known = np.vstack([rows[:m], whole.before])
        steps = scaled_lstsq(known.T, rows[c : c + m].T, DEPENDENT)[0]
        calm = _calm(windows, steps)
        if calm is not None:
            of_calm = _of_calm(windows, noisy, calm)
            found = of_calm if of_calm.share > _MUCH else found
    if found.p_value < _LEVEL:  # an input that noise reaches at once may tell of it
        # Kicks of an input hide whether it answers within the sample.
        first = 1 if within.p_value < _INSTANTANEOUS or calm is not None else 0
        of_most, curved = _of_most(windows, m, noisy, first, calm)
        found = max(found, of_most, key=lambda test: (test.p_value, test.share))
    soon = False
    if found.p_value < _LEVEL:
        nearest = basis_of(future[:m], rows[c : c + m], FORESEEN)
        left, later = (x - (x @ nearest) @ nearest.T for x in (y[noisy], future[m:]))
        next_ones = _wilks(y[noisy], nearest, dof)
        beyond = _wilks(left, basis_of(later, rows[c + m :], FORESEEN), dof - m)
        soon = beyond.share < _LITTLE * next_ones.share
        soon &= within.p_value < _INSTANTANEOUS  # means know the inputs they are over
    p_direct = p_answer = 1.0
    if within.p_value < _INSTANTANEOUS and noisy.any():
        before = scaled_lstsq(whole.before.T, rows[:c].T, DEPENDENT)[0]
        p_direct, p_answer = _straight_lines(windows, before, m, noisy)
    return Feedback(
        p_value=found.p_value,
        share=found.share,
        p_instantaneous=within.p_value,
        curved=curved,
        innovations=np.sum(y**2, axis=1) / max(dof, 1),
        cut_off=cut_off,
        regression=coefficients_of(whole),
        foreseen=foreseen,
        p_direct=p_direct,
        p_answer=p_answer,
        alone=m == 1,
        soon=soon,
    )


def _straight_lines(
    windows: Sequence[_Windows], before: Array, m: int, noisy: NDArray[np.bool_]
) -> tuple[float, float]:
    """Tests whether outputs lie on a straight line over inputs of the sample, and back.

    Of the input that tells most of one which answers them; the others act as they may.
    Of what `before` (n_regressors, n_inputs + n_outputs) does not foresee a sample
    ahead, the errors of a straight line are tested for nonlinear functions.
    """
    left = []
    for linear, outputs, _ in windows:
        left.append(np.vstack([linear[:m], outputs]) - before.T @ linear[m:-1])
    a, b = np.split(np.hstack(left), [m])
    if (np.sum(a[:, 1:] * a[:, :-1], axis=1) > _FOLLOWS * np.sum(a**2, axis=1)).any():
        return 1.0, 1.0  # a slow input, of which a longer past would foresee that
    b, found = b[noisy], []  # others have no noise to be answered
    for j in range(m):
        own, others = a[[j]], np.delete(a, j, axis=0)
        direct = _on_a_line(b, own, others, len(before))
        found.append((direct, _on_a_line(own, b, others, len(before))))
    best = min(found, key=lambda p: (p[1] <= _LIKELY, p[0]))
    # Short pasts of several inputs that act at once have come to 1e-15 in open loop.
    return best if m == 1 or best[0] < _BEYOND_DOUBT else (1.0, 1.0)


def _on_a_line(rows: Array, over: Array, beside: Array, n_regressors: int) -> float:
    """p-value of rows that are linear in others, but for independent errors.

    And linear in what acts `beside` these.
    """
    size = np.sqrt(np.mean(over**2, axis=1, keepdims=True))
    x = over / np.where(size > 0.0, size, 1.0)
    line = np.vstack([np.ones(over.shape[1]), x, beside])
    x = x[np.sum(x**4, axis=1) * _SEVERAL < np.sum(x**2, axis=1) ** 2]
    near, far = np.clip(x, -1.0, 1.0), np.clip(x, -_CLIPPED, _CLIPPED)
    bent = np.vstack([near, np.abs(x) * x, far**3])
    Q = basis_of(line, line, DEPENDENT)
    rows, left = (r - (r @ Q) @ Q.T for r in (rows, bent))
    dof = over.shape[1] - n_regressors - Q.shape[1]
    return _wilks(rows, basis_of(left, bent, FORESEEN), dof).p_value


class _Windows(NamedTuple):
    """A column for every sample that has the past and the future of the test."""

    linear: Array  # present inputs, past samples from the newest on, one
    outputs: Array
    future: Array  # inputs, from the next sample on

    @classmethod
    def of(cls, z: Array, m: int, past: int) -> _Windows:
        """Those of the samples of one record."""
        n_rows = past + 1 + N_FUTURE
        windows = np.lib.stride_tricks.sliding_window_view(z, n_rows, axis=0)
        windows = windows.transpose(0, 2, 1)
        future, windows = windows[:, past + 1 :, :m], windows[:, past::-1]
        before = windows[:, 1:].reshape(len(windows), -1)
        linear = np.hstack([windows[:, 0, :m], before, np.ones((len(windows), 1))])
        return cls(linear.T, windows[:, 0, m:].T, future.reshape(len(future), -1).T)


def _windows_of(records: Sequence[Record], past: int) -> list[_Windows]:
    m, least = len(records[0].u), past + 1 + N_FUTURE
    return [_Windows.of(z, m, past) for z in samples_of(records) if len(z) >= least]


def _calm(windows: Sequence[_Windows], steps: Array) -> NDArray[np.bool_] | None:
    """Samples after which no input stands out; None where none hides the others.

    Of inputs less what `steps` (n_regressors, n_inputs) foresee of them a sample ahead:
    that tells nothing of the innovations unless there is feedback. Values that are held
    until they change answer nothing in between.
    """
    m = steps.shape[1]
    left = [w.future[:m] - steps.T @ w.linear[:-1] for w in windows]
    moves = np.hstack([w.future[:m] != w.linear[:m] for w in windows])
    together = np.hstack(left)
    limit = _OUTLYING * np.median(np.abs(together), axis=1, keepdims=True)
    outside = np.abs(together) > limit
    squares = np.where(outside, together**2, 0.0).sum(axis=1)
    hides = squares > _HIDES * (together**2).sum(axis=1)
    if not (hides & (np.mean(moves & ~outside, axis=1) > _ANSWERS)).any():
        return None
    calm = []
    for part in left:
        near = (np.abs(part) <= limit).all(axis=0)
        # of the last ones the whole future is not known
        follows = np.append(near, np.zeros(N_FUTURE - 1, dtype=bool))
        ahead = np.lib.stride_tricks.sliding_window_view(follows, N_FUTURE)
        calm.append(ahead.all(axis=1))
    return np.concatenate(calm)


def _of_calm(
    windows: Sequence[_Windows], noisy: NDArray[np.bool_], calm: NDArray[np.bool_]
) -> _Correlated:
    """Test of the samples after which no input stands out."""
    L, Y, F = (np.hstack(part)[:, calm] for part in zip(*windows, strict=True))
    sizes = np.cumsum([len(L), int(noisy.sum())])
    if L.shape[1] <= len(L) + len(F):
        return _Correlated(1.0, 0.0)
    R = linalg.qr(np.vstack([L, Y[noisy], F]).T, mode="r", check_finite=False)[0]
    linear, y, future = np.split(R[: R.shape[1]].T, sizes)
    beyond = slice(len(L), None)
    known = basis_of(future[:, beyond], future, FORESEEN)
    return _wilks(y[:, beyond], known, L.shape[1] - len(linear))


def _of_most(
    windows: Sequence[_Windows],
    m: int,
    noisy: NDArray[np.bool_],
    first: int,
    calm: NDArray[np.bool_] | None,
) -> tuple[_Correlated, float]:
    """What most samples tell of feedback, and what a nonlinearity explains.

    Spikes on two channels make a correlation of their own: the first value is the test
    of those samples (`calm` ones, where there is need of these) whose innovations do
    not stand out. The second is the share of the innovations that nonlinear terms of
    the last samples explain, of which the `first` is the sample itself (0), of which
    the `m` inputs are known, or the one before.
    """
    c, curved = m + len(windows[0].outputs), []
    for linear, *_ in windows:
        last = linear[first * m : m + _N_CURVED * c]
        mixed = last[:1] * last[1:]
        curved.append(np.vstack([np.abs(last), last**2, last**3, mixed]))
    L, Y, F = (np.hstack(part) for part in zip(*windows, strict=True))
    N, Y = np.hstack(curved), Y[noisy]
    Q = basis_of(L, L, DEPENDENT)
    left = np.abs(Y - (Y @ Q) @ Q.T)
    half, most = np.quantile(left, (0.5, _MOST), axis=1, keepdims=True)
    common = (left <= np.maximum(_OUTLYING * half, most)).all(axis=0)
    common &= True if calm is None else calm
    some = basis_of(L[:, common], L[:, common], DEPENDENT)
    feedback = _explained(some, Y[:, common], F[:, common])
    return feedback, _explained(Q, Y, N).share


def _explained(Q: Array, rows: Array, terms: Array) -> _Correlated:
    """Test whether terms explain rows beyond what lies in orthonormal columns Q."""
    rows, left = (x - (x @ Q) @ Q.T for x in (rows, terms))
    return _wilks(rows, basis_of(left, terms, FORESEEN), len(Q) - Q.shape[1])


class _Correlated(NamedTuple):
    """Rows and what may explain them."""

    p_value: float  # of all that is explained being by chance
    share: float  # explained of the row of which most is, less what chance does


def _wilks(y: Array, known: Array, dof: int) -> _Correlated:
    """Test whether rows of `dof` degrees of freedom lie in orthonormal columns."""
    y = y[np.sum(y**2, axis=1) > 0.0]
    # Outputs that repeat others tell nothing more. They count as degrees of freedom all
    # the same: where there is no noise, what a short past leaves of them is one signal.
    own = basis_of(y, y, DEPENDENT).T
    q, ny = known.shape[1], len(y)
    dof -= q
    if q == 0 or ny == 0 or dof <= ny:
        return _Correlated(1.0, 0.0)
    explained = own @ known
    left = (1.0 + NO_INNOVATION) * np.eye(len(own)) - explained @ explained.T
    statistic = -(dof + 0.5 * (q - ny - 1)) * np.linalg.slogdet(left)[1]
    p_value = float(special.chdtrc(ny * q, max(statistic, 0.0)))
    unexplained = 1.0 - np.sum((y @ known) ** 2, axis=1) / np.sum(y**2, axis=1)
    share = 1.0 - unexplained * (dof + q) / dof
    return _Correlated(p_value, max(0.0, float(share.max())))
