"""Simulation of parts of the samples that a model has not seen.

Each experiment is cut into pieces of equal length, and every piece but the first is
held out once; of several short ones, whole experiments are. The model is fitted again
without it, from where it was, and simulated through it from the state (and the
constant) that suits it best. Those that the samples before tell would be no measure of
a model: what moves a system besides its inputs adds up behind an integrator. What a
likelihood says rests on its noise model being right; this does not, and so has the last
word where a system is not quite what the models can be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.simulation import estimate_initial_state, free_responses, lti_response
from ..samples.records import Record, thinned
from .simulation_fit import Realization

Array = NDArray[np.float64]

_N_PIECES = 3  # held out in turn: a whole number of refits, and most samples stay

_N_BLOCKS = 5  # of a piece: sums over time whose spread tells that of their total

_MOST = 0.7  # share of an input's motion without which nothing can be said of it

_LONG = 80  # samples of an experiment whose pieces tell more than an initial state

_TOO_SHORT = 8  # samples of an experiment of which nothing is held out

# By which an error must be less to matter, and by which it is so beyond doubt.
MATTERS, _MUCH = 0.03, 0.5

# Standard errors by which another way to a model must be better.
DOUBT = 2.0

_GROWS = 1.001  # modulus of a pole by which its mode is one that grows

_FAR_MORE = 4.0  # times the errors: more than an initial state takes of slow noise


class Part(NamedTuple):
    """Samples held out: errors of simulation from rest, and what is unknown in them."""

    error: Array  # (n_samples, n_outputs)
    free: Array  # (n_samples, n_outputs, n_unknowns): responses to own unknowns
    weight: Array  # (n_outputs, n_outputs): of the errors of which these make the least

    def without(self, free: Array) -> Array:
        """Errors that no combination of responses explains."""
        W = self.weight
        M = np.einsum("ij,tjk->tik", W, free)
        error = self.error @ W.T
        error = error - M @ estimate_initial_state(M, error)
        return np.linalg.solve(W, error.T).T


class HeldOut(NamedTuple):
    """Simulation errors on parts held out."""

    parts: list[Part]
    bft: float  # best fit, percent, mean over outputs; NaN where nothing is held out
    total: float = np.inf  # sum of squares; infinite where nothing is held out
    residual: float = np.nan  # root mean square, in units of the scaled records

    def clearly_better_than(
        self, other: HeldOut, standard_errors: float, share: float = MATTERS
    ) -> bool:
        """Whether errors are less, by more than chance and by a share that matters.

        Compared is what the unknowns of neither model explain: slow noise looks like
        the free response of a slow mode. Chance is so many standard errors of the
        difference. Of half the errors it is not asked: a model that loses the system
        now and then makes them large as well. In pieces of few periods free responses
        hide what inputs do: by its own unknowns alone it must not be far worse.
        """
        if not (np.isfinite(other.total) and np.isfinite(self.total)):
            return bool(np.isfinite(self.total))
        if self.total > _FAR_MORE * other.total:
            return False
        total, gaps = 0.0, []
        for mine, others in zip(self.parts, other.parts, strict=True):
            free = np.concatenate([mine.free, others.free], axis=2)
            errors = others.without(free) ** 2
            gap = errors - mine._replace(weight=others.weight).without(free) ** 2
            total += float(errors.sum())
            blocks = np.array_split(gap, min(_N_BLOCKS, len(gap)))
            gaps += [float(block.sum()) for block in blocks]
        chance = np.std(gaps, ddof=1) * np.sqrt(len(gaps)) if len(gaps) > 1 else 0.0
        least = min(standard_errors * chance, _MUCH * total)
        return bool(np.sum(gaps) > max(least, share * total))


def held_out(
    refitted: Callable[[list[Record]], Realization],
    records: Sequence[Record],
    *,
    weight: Array | None = None,
) -> HeldOut:
    """Errors of a model on pieces of scaled records that it was not fitted to.

    `refitted` makes the model of other records, which may begin in mid-motion; `weight`
    (n_outputs, n_outputs) is that of the errors by which initial states are found.
    """
    W = np.eye(len(records[0].y)) if weight is None else weight
    parts: list[Part] = []
    errors, outputs, n_known = [], [], 0
    records = thinned(records)
    for k in range(1, _N_PIECES + 1):
        cuts = _cuts(records, k)
        train = [
            record.part(part)
            for record, (start, stop) in zip(records, cuts, strict=True)
            for part in (slice(0, start), slice(stop, None))
            if 0 < start == part.stop or record.n_samples - stop >= _TOO_SHORT
        ]
        model = refitted(train)
        for record, (start, stop) in zip(records, cuts, strict=True):
            if start == stop:
                continue
            u, y = record.u.T[start:stop], record.y.T[start:stop]
            trend, known = record.trend[:, start:stop], record.known[start:stop]
            if not known.any():
                continue
            with np.errstate(over="ignore", invalid="ignore"):
                answer, free = _answers(model, u, trend)
                error = np.where(known, y - answer, 0.0)
                free = np.where(known[:, :, None], free, 0.0)
                part = Part(error, free, W)
                error = part.without(part.free)
                # What these unknowns take of the noise is made up for.
                n_values = int(np.count_nonzero(known))
                spare = n_values - free.shape[2]
                if spare > 0:
                    error *= np.sqrt(n_values / spare)
                elif known.all():
                    error *= np.nan
            n_known += n_values
            parts.append(part)
            errors.append(error)
            outputs.append(y)
    if not errors:
        return HeldOut([], np.nan)
    error, output = np.vstack(errors), np.vstack(outputs)
    spread = np.sqrt(((output - output.mean(axis=0)) ** 2).sum(axis=0))
    spread[spread == 0.0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        squares = (error**2).sum(axis=0)
        bft = 100.0 * float(np.maximum(1.0 - np.sqrt(squares) / spread, 0.0).mean())
        total = float(squares.sum())
    bft = bft if np.isfinite(bft) else 0.0
    return HeldOut(parts, bft, total, float(np.sqrt(total / n_known)))


def _answers(model: Realization, u: Array, trend: Array) -> tuple[Array, Array]:
    """Outputs to inputs (n_samples, n_inputs), and to what is unknown.

    Modes that grow are simulated backward, from rest at the end: the free responses
    make up for it, and neither overflows. NaN of a model whose poles are rounding.
    """
    A, B, C, D = model[:4]
    sizes = np.abs(np.linalg.eigvals(A))
    # They are told from others in the widest gap: rounding moves poles on the circle.
    edges = np.sort(sizes[(sizes > 1.0) & (sizes < _GROWS)])
    edges = np.concatenate([[1.0], edges, [_GROWS]])
    widest = int(np.argmax(np.diff(edges)))
    limit = edges[widest : widest + 2].mean()
    if not sizes.max(initial=0.0) > limit:
        return lti_response(A, B, C, D, u), free_responses(A, C, len(u), trend)
    try:
        R, Z, k = linalg.schur(A, sort=lambda re, im=0.0: np.hypot(re, im) < limit)
        X = np.zeros((k, len(A) - k))
        if X.size:  # older versions of scipy refuse an equation without unknowns
            X = linalg.solve_sylvester(R[:k, :k], -R[k:, k:], -R[:k, k:])
        back = np.linalg.inv(R[k:, k:])
    except np.linalg.LinAlgError:  # others after they have changed places
        return np.full((len(u), len(C)), np.nan), np.zeros((len(u), len(C), 0))
    left, right = Z.T[:k] - X @ Z.T[k:], Z[:, :k] @ X + Z[:, k:]
    C_stable, C_growing = C @ Z[:, :k], C @ right
    into, seen = back @ Z.T[k:] @ B, C_growing @ back
    answer = lti_response(R[:k, :k], left @ B, C_stable, D, u)
    answer += lti_response(back, -into, seen, -C_growing @ into, u[::-1])[::-1]
    grown = free_responses(back, seen, len(u))[::-1]
    free = free_responses(R[:k, :k], C_stable, len(u), trend)
    return answer, np.concatenate([grown, free], axis=2)


def _cuts(records: Sequence[Record], k: int) -> list[tuple[int, int]]:
    """Start and end of what is held out of every experiment the k-th time.

    The initial state would take up a piece of a few samples: short experiments beside
    long ones are not cut, and of many short ones the longest half is held out in turn.
    """
    lengths = np.array([record.n_samples for record in records])
    if len(records) < 2 * _N_PIECES or np.median(lengths) >= _LONG:
        whole = (lengths < _LONG) & (lengths.max() >= _LONG)
        return [
            (n, n) if kept else _cut(record.u, k)
            for record, n, kept in zip(records, lengths.tolist(), whole, strict=True)
        ]
    longest = np.argsort(-lengths, kind="stable")[: len(lengths) // 2]
    out = np.isin(np.arange(len(lengths)), longest[k - 1 :: _N_PIECES])
    starts = np.where(out, 0, lengths)
    return list(zip(starts.tolist(), lengths.tolist(), strict=True))


def _cut(u: Array, k: int) -> tuple[int, int]:
    """Start and end of the k-th piece held out.

    The end twice where it is not: of a short experiment, and of one whose inputs
    (n_inputs, n_samples) move but in that piece, such as a step.

    >>> [_cut(np.arange(100.0)[None], k) for k in (1, 2, 3)], _cut(np.ones((1, 5)), 1)
    ([(25, 50), (50, 75), (75, 100)], (5, 5))
    """
    n_samples = u.shape[1]
    if n_samples < _TOO_SHORT:
        return n_samples, n_samples
    size = n_samples // (_N_PIECES + 1)
    start, stop = size * k, n_samples if k == _N_PIECES else size * (k + 1)
    moves = np.diff(u, axis=1, prepend=u[:, :1]) ** 2
    if (moves[:, start:stop].sum(axis=1) > _MOST * moves.sum(axis=1)).any():
        return n_samples, n_samples
    return start, stop
