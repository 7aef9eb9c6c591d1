"""The signals that all responses of a model to records are made of.

With ``A = T diag(A_1, A_2, ...) inv(T)``, blocks of size one or two, every response of
the model is a fixed combination of a few filtered signals that do not depend on B, C
or the initial state. They are what the least-squares problems of `simulation_fit` and
`refinement` are made of. Poles that lie close together share a block, so that a
double pole, or a pair of real poles about to become complex, is not singular.

A block of two states has the resolvent
``inv(z I - A) = ((z - s) I + N) / det(z I - A)`` with ``s`` half its trace and
``N = A - s I``. Driven by ``b v`` from rest its state is
therefore ``d b + g N b``, with the two signals ``d = (z - s) g`` and
``g = v / det(z I - A)``. For one state only ``d`` exists, the state driven by ``v``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import linalg

from ..samples.hankel import factor_of_pieces
from ..samples.records import Record

Array = NDArray[np.float64]

_MAX_CONDITION = 1e8  # of T, beyond which the sections lose half of the digits
_PARALLEL = 1.0 - 1e-8  # cosine of eigenvectors that leave their plane inaccurate
_PIECE = 8192  # samples worked on at a time: their signals stay in the cache

Places = NDArray[np.intp]  # of experiments

# Samples of an experiment up to which several are worked on together.
_SHORT = 256

_LARGEST = 1e200  # squares of responses beyond it would overflow


class Layout(NamedTuple):
    """Where the signals of a kind stand among all of them."""

    sections: slice  # impulse and inputs, of every state
    inputs: slice
    outputs: slice
    second: slice  # of every state, where there are second responses
    trends: slice

    @classmethod
    def of(cls, n: int, m: int, ny: int, *, second: bool = False) -> Layout:
        """That of a model of n states with m inputs and ny outputs."""
        a = n * (1 + m)
        b, c, d = a + m, a + m + ny, a + m + ny + n * second
        return cls(slice(a), slice(a, b), slice(b, c), slice(c, d), slice(d, None))


class Sections(NamedTuple):
    """Block-diagonal form: ``A @ transform = transform @ block_diag(*blocks)``."""

    blocks: tuple[Array, ...]  # of shape (1, 1) or (2, 2)
    transform: Array


def block_sections(A: Array) -> Sections | None:
    """Split a state matrix into sections of two states, and one of one at the front.

    None where the transformation is too ill conditioned: a pole of multiplicity three
    or more, or a repeated complex pair.

    >>> A = np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 0.0], [0.3, 0.0, 0.2]])
    >>> sections = block_sections(A)
    >>> [block.shape[0] for block in sections.blocks]
    [1, 2]
    >>> T = sections.transform
    >>> from scipy.linalg import block_diag
    >>> np.allclose(A @ T, T @ block_diag(*sections.blocks))
    True
    """
    poles, vectors = np.linalg.eig(A)
    real = np.flatnonzero(poles.imag == 0.0)
    real = real[np.argsort(poles[real].real)]
    bases = [
        _invariant_basis(A, poles[real[group]].real, vectors[:, real[group]].real)
        for group in _pair_real(poles[real].real)
    ]
    for i in np.flatnonzero(poles.imag > 0.0):
        bases.append(_orthonormal(np.array([vectors[:, i].real, vectors[:, i].imag]).T))
    transform = np.concatenate(bases, axis=1) if bases else np.zeros((0, 0))
    if len(bases) > 1:
        s = np.linalg.svd(transform, compute_uv=False)
        if not s[0] <= _MAX_CONDITION * s[-1]:
            return None
    blocks = tuple(basis.T @ A @ basis for basis in bases)
    return Sections(blocks, transform)


def _pair_real(poles: Array) -> list[list[int]]:
    """Group real poles, given in ascending order, two by two with their neighbours.

    Of an odd number the one is left alone whose removal keeps the pairs closest.
    """
    n = len(poles)
    if n % 2 == 0:
        return [[i, i + 1] for i in range(0, n, 2)]
    gaps = np.diff(poles).tolist()
    cost = [sum(gaps[0:i:2]) + sum(gaps[i + 1 :: 2]) for i in range(0, n, 2)]
    alone = 2 * cost.index(min(cost))
    rest = [i for i in range(n) if i != alone]
    return [[alone]] + [rest[i : i + 2] for i in range(0, n - 1, 2)]


def _invariant_basis(A: Array, poles: Array, vectors: Array) -> Array:
    """Orthonormal basis of the invariant subspace of one or two real poles."""
    if len(poles) == 2 and abs(vectors[:, 0] @ vectors[:, 1]) > _PARALLEL:
        # A (nearly) defective pair: the null space of (A - p1 I)(A - p2 I).
        eye = np.eye(len(A))
        product = (A - poles[0] * eye) @ (A - poles[1] * eye)
        return linalg.svd(product, check_finite=False)[2][-2:].T
    return _orthonormal(vectors)


def _orthonormal(vectors: Array) -> Array:
    """Orthonormal basis of one or two columns.

    `scipy.linalg.qr` asks LAPACK for sizes of work: 40 us instead of 4.
    """
    qr, tau = linalg.lapack.dgeqrf(vectors)[:2]
    basis: Array = linalg.lapack.dorgqr(qr, tau)[0]
    return basis


def signal_pieces(
    blocks: tuple[Array, ...], record: Record, driven: Array | None = None
) -> Iterator[Array]:
    """Signals of consecutive stretches of a record, (n_signals, n_samples_i).

    Rows as in `Layout`: for each block and each of its signals, the answer to an
    impulse that sets the state at time 0, then those to each input; inputs; outputs;
    second responses where `driven` is given, ``[x0, B]`` of shape (order, 1 +
    n_inputs): what every block answers to its own states, the last signal of it only,
    since ``d = N g + [x0, B] g_u`` for states driven by signals with answers ``g_u``.
    The memory is used again for the next piece.
    """
    (m, n_samples), ny, n_trend = record.u.shape, len(record.y), len(record.trend)
    order = sum(len(block) for block in blocks)
    state_map = None if driven is None else state_coefficients(blocks, driven)
    at = Layout.of(order, m, ny, second=driven is not None)
    memory = np.empty((at.trends.start + n_trend, min(n_samples, _PIECE)))
    first_bank = _SectionBank(blocks, [1 + m] * len(blocks))
    source = np.zeros((1 + m, memory.shape[1]))
    source[0, 0] = 1.0
    if state_map is not None:
        second_bank = _SectionBank(blocks, [len(block) for block in blocks])
        late = np.empty((order, memory.shape[1]))
        last_state = np.zeros(order)
    for start in range(0, n_samples, _PIECE):
        stop = min(start + _PIECE, n_samples)
        n = stop - start
        X = memory[:, :n]
        if start:
            source[0, 0] = 0.0
            source[1:, 0] = record.u[:, start - 1]
        source[1:, 1:n] = record.u[:, start : stop - 1]
        first_bank.run(source[:, :n], X[at.sections].reshape(order, 1 + m, n))
        X[at.inputs] = record.u[:, start:stop]
        X[at.outputs] = record.y[:, start:stop]
        if state_map is not None:
            late[:, 0] = last_state
            late[:, 1:n] = state_map @ X[at.sections, :-1]
            last_state = state_map @ X[at.sections, -1]
            second_bank.run_last(late[:, :n], X[at.second])
        if n_trend:
            X[at.trends] = record.trend[:, start:stop]
        yield X


def signal_factor(
    blocks: tuple[Array, ...], record: Record, driven: Array | None = None
) -> Array | None:
    """Upper triangular factor of the `signal_pieces`; None where they overflow."""
    with np.errstate(over="ignore", invalid="ignore"):
        gram: Array | float = 0.0
        for X in signal_pieces(blocks, record, driven):
            gram = X @ X.T + gram
        gram = np.asarray(gram)
        if not gram.diagonal().max(initial=0.0) < _LARGEST:
            return None
    return factor_of_pieces(gram, signal_pieces(blocks, record, driven)).T


def signal_factors(
    blocks: tuple[Array, ...],
    records: Sequence[Record],
    driven: Array | None = None,
) -> Iterator[tuple[Places, Array | None]]:
    """Factors of all records, those of short ones of like length together.

    Their places, and (n_records, k, n_signals) with the Gramians of the signals; None
    where they overflow. `driven` is (n_records, order, 1 + n_inputs).
    """
    for group in _like_ones(records):
        some = [records[i] for i in group]
        own = None if driven is None else driven[group]
        if len(group) > 1:
            yield np.array(group), _short_factors(blocks, some, own)
        else:
            R = signal_factor(blocks, some[0], None if own is None else own[0])
            yield np.array(group), None if R is None else R[None]


def _like_ones(records: Sequence[Record]) -> list[list[int]]:
    """Places of the records, those of short ones of like length together."""
    if len(records) == 1:
        return [[0]]
    lengths = np.array([record.n_samples for record in records])
    groups: list[list[int]] = []
    for i in np.argsort(lengths, kind="stable").tolist():
        n = int(lengths[i])
        if not groups or n > _SHORT or (len(groups[-1]) + 1) * n > _PIECE:
            groups.append([])
        groups[-1].append(i)
    return groups


def _short_factors(
    blocks: tuple[Array, ...], records: Sequence[Record], driven: Array | None
) -> Array | None:
    """Rows of the `signal_pieces` of records, each in a piece, or their factors.

    Behind the end of a record they are zero.
    """
    (m, _), ny, n_trend = records[0].u.shape, len(records[0].y), len(records[0].trend)
    order, n_records = sum(len(block) for block in blocks), len(records)
    lengths = [record.n_samples for record in records]
    longest, at = max(lengths), Layout.of(order, m, ny, second=driven is not None)
    X = np.zeros((at.trends.start + n_trend, n_records, longest))
    for i, (record, n) in enumerate(zip(records, lengths, strict=True)):
        X[at.inputs, i, :n], X[at.outputs, i, :n] = record[:2]
        if n_trend:
            X[at.trends, i, :n] = record.trend
    source = np.zeros((1 + m, n_records, longest))
    source[0, :, 0] = 1.0
    source[1:, :, 1:] = X[at.inputs, :, :-1]
    width = (1 + m) * n_records
    with np.errstate(over="ignore", invalid="ignore"):
        sections = X[at.sections].reshape(order, width, longest)
        bank = _SectionBank(blocks, [width] * len(blocks))
        bank.run(source.reshape(width, longest), sections)
        if driven is not None:
            late = np.zeros((order, n_records, longest))
            states = state_coefficients(blocks, driven) @ X[at.sections].swapaxes(0, 1)
            late[:, :, 1:] = states.swapaxes(0, 1)[:, :, :-1]
            widths = [len(block) * n_records for block in blocks]
            _SectionBank(blocks, widths).run_last(late, X[at.second])
        for i, n in enumerate(lengths):
            X[:, i, n:] = 0.0
        rows = X.transpose(1, 2, 0)
        if not np.einsum("its,its->is", rows, rows).max(initial=0.0) < _LARGEST:
            return None
        if longest <= len(X):
            return rows.copy()
        return np.asarray(np.linalg.qr(rows, mode="r"))


def section_states(blocks: tuple[Array, ...], added: Array) -> Array:
    """States ``x[t] = A x[t - 1] + added[t]`` from rest, (order, n_samples) both.

    >>> section_states((np.array([[0.5]]),), np.array([[1.0, 0.0, 2.0]]))
    array([[1.  , 0.5 , 2.25]])
    """
    out = np.empty_like(added)
    for block, part in zip(blocks, block_slices(blocks), strict=True):
        denominator = _characteristic(block)
        ahead = scipy.signal.lfilter([1.0], denominator, added[part], axis=1)
        out[part] = ahead
        if len(block) == 2:  # z inv(z I - A) = (z^2 I + z (A - 2 s I)) / det(z I - A)
            rest = block + denominator[1] * np.eye(2)
            out[part, 1:] += rest @ ahead[:, :-1]
    return out


class SharedSignals:
    """Factors of records that differ in their outputs, as realizations of noise do.

    Of one model and one input the signals, and the products of them, are those of the
    record before; only products with the outputs are new.
    """

    def __init__(self) -> None:
        self._of: tuple[Array, ...] = ()
        self._known = np.zeros((0, 0)), np.zeros((0, 0))

    def factors(
        self, blocks: tuple[Array, ...], records: Sequence[Record], driven: Array
    ) -> Iterator[tuple[Places, Array | None]]:
        """As `signal_factors`, of a single record."""
        R = self.factor(blocks, records[0], driven[0])
        yield np.zeros(1, int), None if R is None else R[None]

    def factor(
        self, blocks: tuple[Array, ...], record: Record, driven: Array
    ) -> Array | None:
        """As `signal_factor`, which it asks for what does not fit into a piece."""
        (m, n_samples), (ny, order) = record.u.shape, (len(record.y), len(driven))
        outputs = Layout.of(order, m, ny).outputs
        if n_samples > _PIECE or len(record.trend):
            return signal_factor(blocks, record, driven)
        of = (*blocks, driven, record.u)
        if len(of) != len(self._of) or not all(map(np.array_equal, of, self._of)):
            with np.errstate(over="ignore", invalid="ignore"):
                (X,) = signal_pieces(blocks, record, driven)
                self._of, self._known = of, (X, X @ X.T)
        X, gram = self._known[0], self._known[1].copy()
        X[outputs] = record.y
        with np.errstate(over="ignore", invalid="ignore"):
            gram[outputs] = products = record.y @ X.T
        gram[:, outputs] = products.T
        if not gram.diagonal().max() < _LARGEST:
            return None
        return factor_of_pieces(gram, [X]).T


class _SectionBank:
    """Filters of all blocks, with the memory that a record in pieces needs.

    `widths` are the numbers of signals that drive each block. These come one sample
    late.
    """

    def __init__(self, blocks: tuple[Array, ...], widths: Sequence[int]) -> None:
        self._places = block_slices(blocks)
        self._denominators = [_characteristic(block) for block in blocks]
        self._memory = [
            np.zeros((width, len(block)))
            for block, width in zip(blocks, widths, strict=True)
        ]
        self._last: list[Array | float] = [0.0] * len(blocks)

    def run(self, v: Array, out: Array) -> None:
        """``d`` and, of blocks of two states, ``g`` of every block, one after another.

        The next piece of what drives all of them, (width, n_samples); `out` is
        (order, width, n_samples).
        """
        for i, part in enumerate(self._places):
            ahead, d = self._filtered(i, [1.0], v), out[part.start]
            if part.stop - part.start == 1:
                d[:] = ahead
                continue
            g = out[part.start + 1]
            g[:, 0], g[:, 1:] = self._last[i], ahead[:, :-1]
            self._last[i] = ahead[:, -1].copy()
            np.multiply(g, 0.5 * self._denominators[i][1], out=d)
            d += ahead

    def run_last(self, v: Array, out: Array) -> None:
        """The last of these of every block, driven by rows of its own.

        `v` and `out` are (order, ..., n_samples).
        """
        for i, part in enumerate(self._places):
            late = [1.0] if part.stop - part.start == 1 else [0.0, 1.0]
            own = v[part].reshape(-1, v.shape[-1])
            out[part] = self._filtered(i, late, own).reshape(v[part].shape)

    def _filtered(self, i: int, numerator: list[float], v: Array) -> Array:
        out, self._memory[i] = scipy.signal.lfilter(
            numerator, self._denominators[i], v, axis=1, zi=self._memory[i]
        )
        return out


class Pairs(NamedTuple):
    """The blocks of two states, each ``A = s I + N`` with ``s`` half its trace."""

    first: int  # state of them all, behind the blocks of one
    N: Array  # (n_pairs, 2, 2)

    @classmethod
    def of(cls, blocks: tuple[Array, ...]) -> Pairs:
        """Those among some blocks."""
        first = sum(len(block) == 1 for block in blocks)
        N = np.array(blocks[first:]).reshape(-1, 2, 2)
        half = 0.5 * (N[:, 0, 0] + N[:, 1, 1])
        N[:, 0, 0] -= half
        N[:, 1, 1] -= half
        return cls(first, N)


def state_coefficients(blocks: tuple[Array, ...], driven: Array) -> Array:
    """States in terms of the section signals, (..., order, order * (1 + n_inputs)).

    `driven` is ``[x0, B]``, (..., order, 1 + n_inputs).
    """
    *several, n, width = driven.shape
    out = np.zeros((*several, n, n, width))
    start, N = Pairs.of(blocks)
    own = driven[..., start:, :].reshape(*several, len(N), 2, width)
    turned = N @ own
    for i in range(start):
        out[..., i, i, :] = driven[..., i, :]
    for k, row in enumerate(range(start, n, 2)):
        out[..., row : row + 2, row, :] = own[..., k, :, :]
        out[..., row : row + 2, row + 1, :] = turned[..., k, :, :]
    return out.reshape(*several, n, n * width)


def block_slices(blocks: Sequence[Array]) -> list[slice]:
    """States of every block."""
    stops = accumulate(len(block) for block in blocks)
    return [slice(stop - len(b), stop) for b, stop in zip(blocks, stops, strict=True)]


def block_radius(blocks: Sequence[Array]) -> float:
    """Largest modulus of the poles of blocks of one or two states."""
    radius = 0.0
    for block in blocks:
        if len(block) == 1:
            radius = max(radius, abs(float(block[0, 0])))
            continue
        centre = 0.5 * float(block[0, 0] + block[1, 1])
        det = float(block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0])
        spread = centre * centre - det
        modulus = det**0.5 if spread < 0.0 else abs(centre) + spread**0.5
        radius = max(radius, modulus)
    return radius


def _characteristic(block: Array) -> list[float]:
    """Coefficients of ``det(z I - A)`` of a block, of the highest power first."""
    if len(block) == 1:
        return [1.0, -float(block[0, 0])]
    (a, b), (c, d) = block.tolist()
    return [1.0, -a - d, a * d - b * c]
