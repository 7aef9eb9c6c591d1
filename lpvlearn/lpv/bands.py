"""How uncertain simulated outputs are: by the coefficients, and by the model itself.

Coefficients with the covariance ``P = F F^T`` make outputs of the variance
``diag(J P J^T)``, to first order, with the derivatives J of the outputs. No precision
of coefficients helps where the model is not true: what it leaves of outputs that were
measured is noise, and its own error. The noise is taken to be white; the error of a
model, a system that answers to inputs, is not.

Coefficients that were fitted to records took part of that error with them, which is
back on new ones: it is looked for where a stretch of a record was left out. The model
without the stretch is one step of the search, ``(H - H_s)^-1 g_s`` with the gradient
g_s and the information H_s of the stretch among all of it, H.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed as later
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from ..systems.least_squares import diagonal_scale
from .model import LPVStateSpace
from .refinement import (
    Own,
    Record,
    Refined,
    Run,
    in_turn,
    initial_state,
    weighted_slopes,
)
from .sensitivity import coefficients_of, output_slopes, with_coefficients

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_BANDS = 8  # of frequencies, the quietest of which tells the level of white noise

# Standard deviations of the power of a band, within which others are as quiet; that of
# one ordinate is its mean, neighbours under a Hann window are correlated.
_ALIKE, _ORDINATE = 4.0, 2.0**0.5


_STRETCHES = 4  # of a record, left out in turn in every second record

# Factors of the information's diagonal that dampen a step until it fits what is left.
_DAMPINGS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)


class Levels(NamedTuple):
    """Standard deviations (n_outputs,) of what a model leaves of measured outputs."""

    model_error: Array
    noise: Array

    @property
    def both(self) -> Array:
        """Of both together."""
        return np.asarray(np.hypot(self.model_error, self.noise))


def simulation_std(model: LPVStateSpace, u: Array, kappa: Array, dt: float) -> Array:
    """Standard deviations (n_samples, n_outputs) of outputs simulated from rest.

    By the covariance of the coefficients, which must be known.
    """
    root = model.covariance_root()
    own = replace(model.silenced(), bases=())
    x0 = own.beginning(u, kappa)[0]
    std = np.empty((len(u), model.n_outputs))
    every = np.ones(len(root), bool)
    for rows, J in output_slopes(own, u, kappa, dt, x0, every):
        std[rows] = np.linalg.norm(J[:, :, model.order :] @ root, axis=2)
    return std


@np.errstate(over="ignore", invalid="ignore")  # of models that grow beyond all numbers
def levels_of(errors: Iterable[Array], left_out: Sequence[Array] = ()) -> Levels:
    """Noise and model error behind simulation errors (n_samples, n_outputs) of records.

    The level of the quietest of eight bands of frequencies, and of those that are as
    quiet by chance, is that of white noise; the rest of the mean square is the model's
    own error: of the errors `left_out`, where there are any. Errors of records too
    short to tell are taken for that. Missing ones (NaN) are left out.
    """
    squares, powers = _MeanSquare(), [_MeanSquare() for _ in range(_BANDS)]
    for e in errors:
        squares.add(e)
        known = ~np.isnan(e)
        window = np.hanning(len(e) + 1)[:-1, None] * known
        spectrum = np.fft.rfft(window * np.where(known, e, 0.0), axis=0)[1:-1]
        if len(spectrum) >= _BANDS and window.any(axis=0).all():
            amplitudes = np.abs(spectrum) / np.sqrt(np.sum(window**2, axis=0))
            parts = np.array_split(amplitudes, _BANDS)
            for band, part in zip(powers, parts, strict=True):
                band.add(part)
    total = squares.mean
    noise = np.zeros_like(total)
    if np.any(powers[0].n):
        level = np.array([band.mean for band in powers])
        spread = _ALIKE * _ORDINATE / np.sqrt(powers[0].n)
        quiet = level <= level.min(axis=0) * (1.0 + spread)
        noise = np.minimum(np.mean(level, axis=0, where=quiet), total)
    if left_out:
        beyond = _MeanSquare()
        for e in left_out:
            beyond.add(e)
        total = np.maximum(total, beyond.mean)
    return Levels(np.sqrt(total - noise), np.sqrt(noise))


class _MeanSquare:
    """Of every column of what is added, where it is known; NaN where it never is."""

    def __init__(self) -> None:
        self._sum: Any = 0.0
        self.n: Any = 0  # of values that are known, of every column

    def add(self, values: Array) -> None:
        self._sum = self._sum + np.nansum(values**2, axis=0)
        self.n = self.n + np.count_nonzero(~np.isnan(values), axis=0)

    @property
    def mean(self) -> Array:
        return np.asarray(self._sum / np.where(self.n, self.n, np.nan))


def left_out_errors(
    found: Refined,
    records: Sequence[Record],
    own: Own,
    *,
    run: Run = in_turn,
) -> list[Array]:
    """Errors (n_samples, n_outputs) of records without which the model was fitted.

    `found` on all of the records, with unknowns of their own as they are there.
    """
    model = replace(found.model.silenced(), bases=())
    c, free, weight = coefficients_of(model), found.free, 1.0 / found.deviation
    q = int(free.sum())
    centre, information = c, np.zeros((q, q))
    if found.prior is not None:
        centre, information = found.prior.centre, found.prior.information
        information = information[np.ix_(free, free)]
    folds = [_folds_of(k, len(r.u)) for k, r in enumerate(records)]

    def errors_of(changed: LPVStateSpace) -> list[Array]:
        parts = zip(records, found.own, strict=True)
        return list(run(later(_errors)(changed, r, own, values) for r, values in parts))

    def loss(c: Array, errors: list[Array], fold: int) -> float:
        kept = (
            e[numbers != fold] * weight
            for e, numbers in zip(errors, folds, strict=True)
        )
        away = (c - centre)[free]
        with np.errstate(over="ignore"):  # it nearly diverges
            return float(sum(np.sum(e**2) for e in kept) + away @ information @ away)

    errors = errors_of(model)
    G = np.zeros((1 + max(int(numbers.max()) for numbers in folds), 1 + q, 1 + q))
    several = run(
        later(_grams)(model, r, own, weight, free, e, values, numbers, len(G))
        for r, e, values, numbers in zip(records, errors, found.own, folds, strict=True)
    )
    for grams in several:
        G += grams
    H = information + G[:, 1:, 1:].sum(axis=0)
    size = diagonal_scale(H)
    out = [e.copy() for e in errors]
    for fold, gram in enumerate(G):
        left, g = (H - gram[1:, 1:]) / size[:, None] / size, gram[0, 1:] / size
        before = loss(c, errors, fold)
        for damping in _DAMPINGS:
            try:
                step = cho_solve(cho_factor(left + damping * np.eye(q)), g) / size
                trial = c.copy()
                trial[free] += step
                moved = errors_of(with_coefficients(model, trial))
            except ValueError:  # no such step, no such model, or one that diverges
                continue
            if loss(trial, moved, fold) <= before:
                for values, e, numbers in zip(out, moved, folds, strict=True):
                    values[numbers == fold] = e[numbers == fold]
                break
    return out


def _folds_of(k: int, n_samples: int) -> NDArray[np.intp]:
    """The fold in which each sample of the k-th record is left out."""
    return k % 2 * _STRETCHES + np.arange(n_samples) * _STRETCHES // n_samples


def _errors(model: LPVStateSpace, record: Record, own: Own, values: Array) -> Array:
    """Simulation errors with given unknowns of the record."""
    x0 = initial_state(model, record, own, values)
    y = model.simulate(record.u, record.kappa, record.dt, initial_state=x0)
    constants = values[model.order * own.initial_state :] if own.constant else 0.0
    return np.asarray(y + constants - record.y)


def _grams(
    model: LPVStateSpace,
    record: Record,
    own: Own,
    weight: Array,
    free: Flags,
    errors: Array,
    values: Array,
    folds: NDArray[np.intp],
    n_folds: int,
) -> Array:
    """``[r J]^T [r J]`` of weighted errors and slopes in every fold."""
    total = np.zeros((n_folds, 1 + free.sum(), 1 + free.sum()))
    slopes = weighted_slopes(model, record, own, weight, free, errors, values)
    for rows, Z in slopes:
        for fold in np.unique(folds[rows]):
            part = Z[folds[rows] == fold, :, len(values) :]
            flat = part.reshape(-1, part.shape[2])
            total[fold] += flat.T @ flat
    return total
