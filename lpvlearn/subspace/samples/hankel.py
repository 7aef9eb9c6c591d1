"""Compression of block-Hankel data to a triangular factor.

Subspace identification needs, of the long matrix of stacked past and future
samples, only the triangular factor of its LQ decomposition (Verhaegen and Dewilde,
1992). A QR decomposition of the ``r`` stacked rows over ``N`` columns costs about
``2 N r**2`` operations. Here the Gram matrix of the rows is built from the
correlation sequence of the data, because a block row of a Hankel matrix differs
from the previous one by one sample at each end (displacement rank two), and one
Cholesky factorisation of size ``r`` gives the same factor. Where squaring the
condition number would cost accuracy, the QR decomposition is used instead.

A constant of every experiment, or a constant and a drift, that is not the system's is
projected out of the columns of that experiment (`n_trend`): shifted in time a constant
stays one, so that nothing of it is left, where subtracting the mean of the samples
leaves what the means of the windows differ by.

Several experiments are pooled by adding Gram matrices or by stacking factors; no
column ever crosses the border between two experiments. A stream is pooled likewise,
batch by batch: its `HankelSum` grows by the columns that each batch completes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from ...systems.simulation import trend_signals

Array = NDArray[np.float64]

# Smallest squared pivot of the Gram matrix, rows scaled to one, that is trusted: below
# it rounding acts like noise at a relative level of more than 1e-5 on that row's part
# that the rows before it do not contain.
_MIN_PIVOT = 1e-10

# Rows of a Gram matrix that are summed up, moved or mirrored at a time: what is needed
# besides the matrix is small, and a square of that size stays in the cache.
_BLOCK = 64

_TOGETHER = 32  # experiments whose ends are multiplied at a time

# Samples transformed at a time: transforms this many times as long as the lags (and no
# shorter than the second) spend little on the overlap of neighbouring blocks.
_LAG_BLOCKS, _LEAST_BLOCK = 8, 4096

# Rows from which on a QR decomposition is not cheap; it takes ten times as long.
_MANY_ROWS = 200

_QR_BLOCK = 64  # columns that LAPACK's QR works on at a time, at most

# Hankel columns factored at a time: this many for each row (at least the second), so
# that the factor carried along adds little to each QR.
_COLUMNS_PER_ROW, _LEAST_COLUMNS = 4, 1024


def data_factors(
    records: Sequence[Array],
    n_inputs: int,
    horizons: Collection[int],
    *,
    past_outputs: bool = True,
    n_trend: int = 0,
    cheap: bool = False,
) -> Iterator[Array | None]:
    """Lower triangular factor of ``[U_f; U_p; Y_p; Y_f]`` for every horizon.

    Of pooled experiments, whose rows are samples ``[u, y]``. `past_outputs` tells
    whether ``Y_p`` is among the rows of the factor (Verhaegen and Verdult, *Filtering
    and System Identification*, 2007, Chapter 9). `n_trend` takes a constant (1) or a
    straight line (2) out of every experiment.

    The factor is that of a Gram matrix, built from correlations that serve all
    horizons; that of a QR decomposition, which is the same, where squaring would lose
    accuracy. With `cheap` None stands for those of many rows, but for the first.

    >>> z = np.random.default_rng(0).standard_normal((300, 3))
    >>> [L.shape for L in data_factors([z], n_inputs=2, horizons=[4, 5])]
    [(24, 24), (30, 30)]
    """
    records = [without_trend(z, n_trend) for z in records]
    known: dict[int, Array] = {}
    if len(horizons) > 1:
        known = pooled_correlations(records, [2 * horizon for horizon in horizons])
    n_outputs = records[0].shape[1] - n_inputs
    for k, horizon in enumerate(horizons):
        rows = _past_future_rows(n_inputs, n_outputs, horizon, past_outputs)
        problem = records, 2 * horizon, rows
        gram = _pooled_gram(*problem, known.get(2 * horizon), n_trend)
        factor = cholesky_factor(gram, overwrite=True)
        del gram
        if factor is None and not (cheap and k > 0 and len(rows) > _MANY_ROWS):
            factor = _qr_factor(*problem, n_trend)
        yield factor


def pooled_correlations(
    records: Sequence[Array], n_lags: Collection[int]
) -> dict[int, Array]:
    """Of so many lags the sum of the `correlation_sequence`s of all that are as long.

    >>> z = np.array([[1.0], [2.0], [3.0]])
    >>> pooled_correlations([z, z[:2]], [2, 3])[3].ravel()
    array([14.,  8.,  3.])
    """
    c = records[0].shape[1]
    found = {n: np.zeros((n, c, c)) for n in n_lags}
    for z in records:
        wanted = [n for n in n_lags if n <= len(z)]
        if wanted:
            lags = correlation_sequence(z, max(wanted))
            for n in wanted:
                found[n] += lags[:n]
    return found


def hankel_factor(
    records: Sequence[Array], n_rows: int, rows: NDArray[np.intp], n_trend: int = 0
) -> Array:
    """Lower triangular factor of some `rows` of `n_rows` block rows, in that order.

    `n_trend` as in `data_factors`, of samples that have little of a trend
    (`without_trend`).
    """
    gram = _pooled_gram(records, n_rows, rows, None, n_trend)
    factor = cholesky_factor(gram, overwrite=True)
    return _qr_factor(records, n_rows, rows, n_trend) if factor is None else factor


def _qr_factor(
    records: Sequence[Array], n_rows: int, rows: NDArray[np.intp], n_trend: int = 0
) -> Array:
    """Triangular factor of the pooled Hankel columns by a blocked QR.

    Records shorter than `n_rows` give no column; `rows` are kept, in that order.
    """
    factor = np.zeros((len(rows), 0))
    block = max(_COLUMNS_PER_ROW * len(rows), _LEAST_COLUMNS)
    for z in records:
        if len(z) < n_rows:
            continue
        columns = _hankel_matrix(z, n_rows)
        Q = _trend_basis(columns.shape[1], n_trend)
        sums = _trend_sums(z, n_rows, Q)[rows]
        for start in range(0, columns.shape[1], block):
            part = columns[:, start : start + block][rows]
            if n_trend:
                part = part - sums @ Q[:, start : start + block]
            factor = stack_factors([factor, part])
    return factor if factor.shape[1] else np.zeros((len(rows), len(rows)))


def _pooled_gram(
    records: Sequence[Array],
    n_rows: int,
    rows: NDArray[np.intp],
    correlations: Array | None = None,
    n_trend: int = 0,
) -> Array:
    """Gram matrix of the rows to keep, over all Hankel columns."""
    used = [z for z in records if len(z) >= n_rows]
    if not used:
        return np.zeros((len(rows), len(rows)))
    return _reordered(_hankel_gram(used, n_rows, correlations, n_trend), rows)


def _reordered(gram: Array, rows: NDArray[np.intp]) -> Array:
    """Some rows and columns in another order: in place where none is left out."""
    if len(rows) < len(gram):
        return gram[np.ix_(rows, rows)]
    for start in range(0, len(gram), _BLOCK):
        gram[start : start + _BLOCK] = gram[start : start + _BLOCK, rows]
    moved = np.zeros(len(rows), dtype=bool)
    for first in range(len(rows)):  # rows along the cycles of the permutation
        row, kept = first, gram[first].copy()
        while not moved[row]:
            moved[row], source = True, rows[row]
            gram[row] = kept if source == first else gram[source]
            row = source
    return gram


def without_trend(z: Array, n_trend: int) -> Array:
    """Samples less their mean (1) or straight line (2), by least squares.

    Changes nothing of what is left after the projection but its rounding.
    """
    Q = _trend_basis(len(z), n_trend)
    return z - Q.T @ (Q @ z) if n_trend else z


def _trend_basis(n_samples: int, n_trend: int) -> Array:
    """Orthonormal rows with the span of the trends."""
    # The constant and the line are orthogonal to one another.
    trends = trend_signals(n_samples, min(n_trend, n_samples))
    size = np.linalg.norm(trends, axis=1, keepdims=True)
    return trends / size


def _trend_sums(z: Array, n_rows: int, Q: Array) -> Array:
    """Products of all rows of a Hankel matrix with those of Q, (height, n_trend)."""
    n_cols = Q.shape[1]
    rows = [(Q @ z[j : j + n_cols]).T for j in range(n_rows if len(Q) else 0)]
    return np.concatenate(rows) if rows else np.zeros((n_rows * z.shape[1], 0))


def _past_future_rows(
    n_inputs: int, n_outputs: int, horizon: int, past_outputs: bool = True
) -> NDArray[np.intp]:
    """Rows of a Hankel matrix of ``[u, y]`` in the order ``U_f, U_p, (Y_p), Y_f``."""
    c = n_inputs + n_outputs
    past, future = np.arange(2 * horizon * c).reshape(2, horizon, c)
    parts = [future[:, :n_inputs], past[:, :n_inputs]]
    if past_outputs:
        parts.append(past[:, n_inputs:])
    parts.append(future[:, n_inputs:])
    return np.concatenate([part.ravel() for part in parts])


class HankelSum(NamedTuple):
    """Compressed block-Hankel data of a stream."""

    n_inputs: int
    n_outputs: int
    horizon: int
    past_outputs: bool
    gram: Array | None  # (r, r), of all windows; None where the data need the factor
    factor: Array | None  # (r, r), triangular, instead of the Gram matrix
    tail: Array  # at most 2 * horizon - 1 last samples of what may continue
    n_trend: int = 0  # that is projected out of every stretch of samples

    @property
    def rows(self) -> NDArray[np.intp]:
        """Rows of the Hankel matrix that are kept, in their order."""
        sizes = self.n_inputs, self.n_outputs, self.horizon
        return _past_future_rows(*sizes, self.past_outputs)

    def triangular(self) -> Array:
        """Triangular factor of everything seen."""
        if self.gram is None:
            return np.zeros((0, 0)) if self.factor is None else self.factor
        lower = cholesky_factor(self.gram)
        if lower is not None:
            return lower
        # Later samples of another size may hide what the first ones showed.
        values, vectors = np.linalg.eigh(self.gram)
        return stack_factors([vectors * np.sqrt(np.maximum(values, 0.0))])


def start_hankel_sum(
    samples: Sequence[Array],
    n_inputs: int,
    horizon: int,
    *,
    past_outputs: bool = True,
    n_trend: int = 0,
) -> HankelSum:
    """Summary of the first experiments, of which the last may continue.

    `samples` are scaled, ``[u, y]``: one (n_samples_i, n_channels) per experiment.

    >>> z = np.random.default_rng(0).standard_normal((300, 3))
    >>> parts = start_hankel_sum([z[:100]], n_inputs=2, horizon=4)
    >>> parts = extend_hankel_sum(parts, z[100:], starts=False)
    >>> np.allclose(parts.triangular(), *data_factors([z], n_inputs=2, horizons=[4]))
    True
    """
    c = samples[0].shape[1]
    none, sizes = np.zeros((0, c)), (n_inputs, c - n_inputs, horizon)
    empty = HankelSum(*sizes, past_outputs, None, None, none, n_trend)
    rows, n_rows = empty.rows, 2 * horizon
    tail = samples[-1][-(n_rows - 1) :].copy()
    samples = [without_trend(z, n_trend) for z in samples]
    gram = _pooled_gram(samples, n_rows, rows, n_trend=n_trend)
    if cholesky_factor(gram) is None:
        factor = _qr_factor(samples, n_rows, rows, n_trend)
        return empty._replace(factor=factor, tail=tail)
    return empty._replace(gram=gram, tail=tail)


def extend_hankel_sum(state: HankelSum, samples: Array, *, starts: bool) -> HankelSum:
    """Add the next samples; `starts` tells whether they begin a new experiment."""
    z = samples if starts else np.vstack([state.tail, samples])
    n_rows = 2 * state.horizon
    tail = z[-(n_rows - 1) :].copy()
    if len(z) < n_rows:
        return state._replace(tail=tail)
    z = without_trend(z, state.n_trend)
    if state.gram is not None:
        added = _pooled_gram([z], n_rows, state.rows, n_trend=state.n_trend)
        return state._replace(gram=state.gram + added, tail=tail)
    assert state.factor is not None
    added = _qr_factor([z], n_rows, state.rows, state.n_trend)
    return state._replace(factor=stack_factors([state.factor, added]), tail=tail)


def cholesky_factor(gram: Array, *, overwrite: bool = False) -> Array | None:
    """Lower Cholesky factor, or None where it would not be trustworthy.

    That is where the matrix is not numerically positive definite or, after scaling to a
    unit diagonal, a squared pivot is below `_MIN_PIVOT`.

    >>> cholesky_factor(np.diag([4.0, 9.0])).diagonal()
    array([2., 3.])
    >>> cholesky_factor(np.ones((2, 2))) is None
    True
    """
    diagonal = gram.diagonal()
    if gram.size == 0 or not diagonal.min() > 0.0:
        return None
    scale = np.sqrt(diagonal)
    scaled = np.divide(gram, scale, out=gram if overwrite else None)
    scaled /= scale[:, None]
    # LAPACK sees the transposed (Fortran) matrix: its upper factor is our lower one.
    # Called itself it takes 9 ms for 900 rows, linalg.cholesky 12 ms, numpy's 21 ms.
    upper, info = linalg.lapack.dpotrf(scaled.T, lower=0, clean=1, overwrite_a=1)
    if info != 0 or not upper.diagonal().min() ** 2 > _MIN_PIVOT:
        return None
    lower = upper.T
    lower *= scale[:, None]
    return lower


def triangularize(columns: Array) -> Array:
    """Upper triangular QR factor of ``columns.T``; one row per signal, overwritten."""
    # `scipy.linalg.qr` would ask LAPACK for the size of its work each time.
    n_work = _QR_BLOCK * len(columns)
    factored = linalg.lapack.dgeqrf(columns.T, lwork=n_work, overwrite_a=1)[0]
    return np.triu(factored[: len(columns)])


def stack_factors(factors: Sequence[Array]) -> Array:
    """Triangular factor of several factors side by side.

    ``[L_1, L_2, ...] = L Q``: the factor of all columns from the factors of parts, the
    one operation behind pooling, streaming and map-reduce (TSQR). Square, lower
    triangular, with a non-negative diagonal.

    >>> stack_factors([np.array([[3.0]]), np.array([[4.0]])])
    array([[5.]])
    """
    wide = np.concatenate(factors, axis=1)
    r = wide.shape[0]
    upper = triangularize(wide)
    lower = np.zeros((r, r))
    lower[:, : upper.shape[0]] = upper.T
    signs = np.where(np.diagonal(lower) < 0.0, -1.0, 1.0)
    return lower * signs


def factor_of_pieces(gram: Array, pieces: Iterable[Array]) -> Array:
    """Triangular factor of columns in pieces, whose Gram matrix is known.

    By the pieces, which are not looked at before, where squaring would lose accuracy.

    >>> piece = np.array([[3.0, 4.0]])
    >>> factor_of_pieces(2 * piece @ piece.T, [piece, piece]) ** 2
    array([[50.]])
    """
    lower = cholesky_factor(gram)
    if lower is None:
        lower = np.zeros((len(gram), 0))
        for piece in pieces:
            lower = stack_factors([lower, piece])
    return lower


def _hankel_matrix(z: Array, n_rows: int) -> Array:
    """Block-Hankel matrix: column ``t`` stacks ``z[t], ..., z[t + n_rows - 1]``.

    Samples are the rows of `z`. A read-only view of it where possible.
    """
    n, c = z.shape
    flat = np.ascontiguousarray(z).ravel()
    windows = np.lib.stride_tricks.sliding_window_view(flat, n_rows * c)[::c]
    return windows[: n - n_rows + 1].T


def _hankel_gram(
    records: Sequence[Array],
    n_rows: int,
    correlations: Array | None = None,
    n_trend: int = 0,
) -> Array:
    """Sum of the Gram matrices ``H H.T`` of block-Hankel matrices, not forming ``H``.

    The first block row follows from the correlation sequence minus the products that
    the last columns do not contain; the others from the recursion
    ``G[i+1, j+1] = G[i, j] - z[i] z[j].T + z[n_cols+i] z[n_cols+j].T``. Both are linear
    in G: one recursion serves all records. With their known `correlations` the cost
    does not depend on the number of samples.

    >>> z = np.arange(12.0).reshape(6, 2)
    >>> H = _hankel_matrix(z, 3)
    >>> np.allclose(_hankel_gram([z, z], 3), 2 * H @ H.T)
    True
    """
    c, n_ends = records[0].shape[1], n_rows - 1
    if correlations is None:
        correlations = pooled_correlations(records, [n_rows])[n_rows]
    first, height = correlations.copy(), n_rows * c
    # One block step down a diagonal is `stride` entries ahead in memory: with rows of
    # that length the recursion is a cumulative sum down the columns. What runs
    # over the right edge lands below the diagonal, which is overwritten at the end.
    stride = c * (height + 1)
    memory = np.zeros(n_rows * stride)
    gram = memory[: height * height].reshape(height, height)
    for k in range(0, len(records), _TOGETHER):
        some = records[k : k + _TOGETHER]
        step = len(some)
        tails = np.stack([z[len(z) - n_ends :] for z in some], axis=1)
        lasts = tails.reshape(-1, c)
        for d in range(n_ends):
            first[d] -= lasts[: (n_ends - d) * step].T @ lasts[d * step :]
        _add_products(gram[c:, c:], tails.swapaxes(0, 1).reshape(step, -1), 1.0)
        heads = np.stack([z[:n_ends].ravel() for z in some])
        _add_products(gram[c:, c:], heads, -1.0)
    gram[:c] = first.transpose(1, 0, 2).reshape(c, height)
    steps = memory.reshape(n_rows, stride)
    for i in range(1, n_rows):
        steps[i] += steps[i - 1]
    for k in range(0, len(records) if n_trend else 0, _TOGETHER):
        sums = [
            _trend_sums(z, n_rows, _trend_basis(len(z) - n_ends, n_trend)).T
            for z in records[k : k + _TOGETHER]
        ]
        _add_products(gram, np.vstack(sums), -1.0)
    # The lower triangle by transposed blocks: cheaper than two masks.
    for start in range(0, height, _BLOCK):
        stop = min(start + _BLOCK, height)
        gram[stop:, start:stop] = gram[start:stop, stop:].T
        square = gram[start:stop, start:stop]
        square[:] = np.triu(square) + np.triu(square, 1).T
    return gram


def _add_products(gram: Array, rows: Array, sign: float) -> None:
    """Add ``sign * rows.T @ rows`` to the upper triangle of a matrix."""
    for start in range(0, len(gram), _BLOCK):
        part = sign * rows[:, start : start + _BLOCK]
        gram[start : start + _BLOCK, start:] += part.T @ rows[:, start:]


def correlation_sequence(z: Array, n_lags: int) -> Array:
    """Sums of lagged products over the whole record.

    ``R[d] = sum_t z[t] z[t + d].T`` for ``d = 0 .. n_lags - 1``, by overlapping
    Fourier transforms, so that the cost grows as ``N log(n_lags)``; no more lags than
    samples.

    >>> correlation_sequence(np.array([[1.0], [2.0], [3.0]]), 2).ravel()
    array([14.,  8.])
    """
    n, c = z.shape
    block = min(n, max(_LAG_BLOCKS * n_lags, _LEAST_BLOCK))
    size = fft.next_fast_len(block + n_lags - 1, real=True)
    spectrum = np.zeros((c, c, size // 2 + 1), dtype=complex)
    for start in range(0, n, block):
        head = fft.rfft(z[start : start + block], size, axis=0).T
        tail = fft.rfft(z[start : start + block + n_lags - 1], size, axis=0).T
        spectrum += head.conj()[:, None, :] * tail[None, :, :]
    lags = fft.irfft(spectrum, size, axis=2)[:, :, :n_lags]
    return np.ascontiguousarray(lags.transpose(2, 0, 1))
