"""Regressions of whitened errors, and what they add: the F test and its parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import special

from ..simulation_error.noise import autoregression, through_filter, whitening_filter

Array = NDArray[np.float64]

# Part of a regressor's size that others do not explain, below which it is taken for a
# combination of them: inputs of a few sines, or held for many samples.
DEPENDENT = 1e-4


class ResidualTest(NamedTuple):
    """Statistic, about chi-squared by its degrees of freedom where all is well.

    For an F test it is ``dof * F``. The p-value is 1 where there is nothing to test:
    no regressor that is independent of the rest, or errors that are zero.
    """

    statistic: float
    dof: int
    p_value: float


def through_modes(poles: NDArray[np.complex128], u: Array, times: int = 1) -> Array:
    """Answers of modes to signals, that go through every pole so many times."""
    poles = np.asarray(poles, dtype=complex)
    outside = np.abs(poles) > 1.0  # reflected: their own answers would overflow
    poles = np.where(outside, 1.0 / np.where(outside, poles, 1.0).conj(), poles)
    spanned, signals = [np.zeros((len(u), 0))], u
    for pole in np.tile(poles[poles.imag >= 0.0], times):
        late = signals.astype(complex)
        answer = scipy.signal.lfilter([0.0, 1.0], [1.0, -pole], late, axis=0)
        spanned += [answer.real, answer.imag] if pole.imag else [answer.real]
        denominator = np.poly([pole, pole.conj()] if pole.imag else [pole]).real
        signals = scipy.signal.lfilter(denominator[::-1], denominator, signals, axis=0)
    return np.hstack(spanned)


def whitening_filters(errors: Sequence[Array]) -> list[Array]:
    """Coefficients ``[1, a_1, ..., a_p]`` that whiten the errors of every output."""
    return [
        whitening_filter(autoregression([e[:, [i]] for e in errors]))
        for i in range(errors[0].shape[1])
    ]


def filtered(signals: Sequence[Array], filters: Sequence[Array]) -> list[Array]:
    """Signals through a filter of every column, but for the first samples of all."""
    start = max(map(len, filters)) - 1
    return [
        np.column_stack(
            [
                through_filter(a, x, start)
                for a, x in zip(filters, signal.T, strict=True)
            ]
        )
        for signal in signals
    ]


def f_test(added: Array, target: Array, dof: int) -> ResidualTest:
    """What added columns explain of a target of so many degrees of freedom."""
    left, q = without(added, target)
    error = dof - q
    if q == 0 or error < 1 or not target.any():
        return ResidualTest(0.0, q, 1.0)
    loss = max(float(left @ left), np.finfo(float).tiny)
    explained = float(np.sum((target - left) ** 2))
    statistic = explained / loss * error
    return ResidualTest(statistic, q, float(special.fdtrc(q, error, statistic / q)))


def of_size_one(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    return columns / np.where(size > 0.0, size, 1.0)


def without(known: Array, columns: Array) -> tuple[Array, int]:
    """What known ones, of size one, do not explain, and of how many directions."""
    Q = _basis(known)
    left = columns - Q @ (Q.T @ columns)
    return left - Q @ (Q.T @ left), Q.shape[1]  # once more: it may be small


def _basis(columns: Array) -> Array:
    """Basis of the directions in which columns of size one are not small.

    Orthonormal up to rounding by the square of what is small. By singular values: which
    columns a pivoted factorisation leaves out turns on rounding where some are
    combinations of others, and so would what it spans.
    """
    squares, V = np.linalg.eigh(columns.T @ columns)
    large = squares > DEPENDENT**2
    return columns @ (V[:, large] / np.sqrt(squares[large]))
