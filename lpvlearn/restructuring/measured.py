"""Measured frequency responses: tables, and the error against one.

The error is known at the measured frequencies only, so its maximum over them is a lower
bound of the H-infinity norm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..systems.hinf_norm import PeakSet
from ..validation import (
    SQUARED,
    complex_array,
    real_array,
    shown,
    squarable,
    whole_number,
)
from .error_system import (
    ErrorSystem,
    Structure,
    Target,
    model_response,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Relative difference of measured neighbours that count as equally high: at an optimum
# two of them often are, up to what the search has still to gain.
_BESIDE = 1e-3

_MOST_AVERAGES = 10**9  # of a response: no record has more

# Gains in units that make sense. The searches take fourth powers of smaller ones, and
# begin with parameters about one, from where they do not come to larger ones: those of
# a mass on a spring they miss from 1e28 on.
SMALLEST, LARGEST = 1e-60, 1e20

_LEAST = 1e-100  # deviation or coherence, which are squared

# A coherence is estimated from few averages: never nearer to one than that
_LEAST_INCOHERENCE = 1e-6

# What is not frequencies may be samples
_OF_SAMPLES = (
    " These are to be frequencies, in rad/s. Of samples of inputs and outputs identify "
    "a model first: fit_model(SubspaceLTI().fit(X, y).lti_), or use `LocalLPVPipeline`."
)


class MeasuredErrorSystem(ErrorSystem):
    """The error of a structure against a measured frequency response.

    The maximum runs over the measured frequencies only: a lower bound of the
    H-infinity norm.
    """

    peaks_move = False

    def __init__(
        self,
        structure: Structure,
        omega: Array,
        G: Complex,
        weight: Complex | None = None,
    ) -> None:
        n_outputs, n_inputs = G.shape[1:]
        empty = np.zeros((0, 0))
        D = np.zeros((n_outputs, n_inputs))
        nothing = Target(empty, np.zeros((0, n_inputs)), np.zeros((n_outputs, 0)), D)
        super().__init__(structure, nothing)
        order = np.argsort(omega)
        self.omega, self.G = omega[order], G[order]
        self.fastest = float(self.omega[-1])
        self.grid = self.omega
        unit = np.broadcast_to(np.eye(n_outputs), (len(omega), n_outputs, n_outputs))
        self.W = (unit if weight is None else weight[order]).astype(complex)

    def reweighted(self, weight: Target) -> ErrorSystem:
        """The same error behind one more weight (a scalar one)."""
        factor = model_response(weight, self.omega)[:, :1, :1]
        return MeasuredErrorSystem(self.structure, self.omega, self.G, factor * self.W)

    def resonances(self, poles: Complex) -> Array:
        """None: no frequency lies between the measured ones."""
        return np.zeros(0)

    def _weight_response(self, omega: Array) -> tuple[Complex, Complex, Complex]:
        """The weight at some of the measured frequencies."""
        W = self.W[np.searchsorted(self.omega, omega)]
        return W, np.zeros_like(W), np.zeros_like(W)

    def _target_response(self, omega: Array) -> Complex:
        """The measured response at some of the measured frequencies."""
        return self.G[np.searchsorted(self.omega, omega)]

    def _target_derivatives(self, omega: Array) -> tuple[Complex, Complex, Complex]:
        G0 = self.target_response(omega)
        return G0, np.zeros_like(G0), np.zeros_like(G0)

    def peaks(self, theta: Array, within: float | None = None) -> PeakSet:
        """Local maxima of the error over the measured frequencies.

        And their neighbours that are as high: at an optimum two often are equal.
        """
        E = self.W @ (self.response(theta, self.omega) - self.G)
        sigma = np.linalg.norm(E, 2, axis=(1, 2))
        top = float(sigma.max())
        rising = np.r_[True, sigma[1:] >= sigma[:-1]]
        falling = np.r_[sigma[:-1] >= sigma[1:], True]
        level = top if within is None else (1.0 - within) * top
        beside = sigma >= (1.0 - _BESIDE) * top
        index = np.flatnonzero((rising & falling | beside) & (sigma >= level))
        index = index[np.argsort(-sigma[index], kind="stable")]
        return PeakSet(top, self.omega[index], sigma[index])


def stack_response(G: Complex) -> Array:
    """(n_freq, n_outputs, n_inputs) to (n_freq, 2 n_outputs n_inputs), real first."""
    flat = G.reshape(len(G), G.shape[1] * G.shape[2])
    return np.hstack([flat.real, flat.imag])


def read_frequency_data(
    omega: ArrayLike, frf: ArrayLike, n_outputs: int, n_inputs: int
) -> tuple[Array, Complex]:
    """The data of `GrayBoxRestructurer.fit`, or a ValueError that teaches.

    Frequencies (n_freq,) and the response there (n_freq, n_outputs, n_inputs).
    """
    grid = squarable("omega", real_array("omega", omega))
    if grid.ndim == 2 and grid.shape[1] == 1:
        grid = grid[:, 0]
    if grid.ndim != 1 or len(grid) == 0:
        raise ValueError(
            "`omega` must have shape (n_freq,) or (n_freq, 1) with n_freq >= 1. "
            f"Got {grid.shape}." + _OF_SAMPLES
        )
    if not np.isfinite(grid).all() or (grid < 0).any() or not (grid > 0).any():
        raise ValueError(
            "`omega` must be finite, not negative, and not only zero. Got "
            f"{grid.min():.4g} to {grid.max():.4g}." + _OF_SAMPLES
        )
    if (least := grid[grid > 0].min()) < 1.0 / SQUARED:
        raise ValueError(
            f"`omega` must hold zero or numbers of at least {1.0 / SQUARED:g}, as they "
            f"are squared. Got {least:.4g}; take another unit."
        )
    if len(np.unique(grid)) != len(grid):
        raise ValueError(f"`omega` must hold every frequency once. Got {shown(omega)}.")
    G = complex_array("frf", frf)
    entries = n_outputs * n_inputs
    if np.iscomplexobj(frf):
        if G.size != len(grid) * entries or G.shape[:1] != grid.shape:
            raise ValueError(
                f"complex `frf` must have shape ({len(grid)}, {n_outputs}, "
                f"{n_inputs}). Got {G.shape}."
            )
    else:
        table = real_array("frf", frf)
        if table.shape != (len(grid), 2 * entries):
            raise ValueError(
                f"`frf` must have shape ({len(grid)}, {2 * entries}): real parts of "
                f"the {n_outputs} x {n_inputs} entries row by row, then imaginary. "
                f"Got {table.shape}."
            )
        G = table[:, :entries] + 1j * table[:, entries:]
    if not np.isfinite(G).all():
        k = int(np.argwhere(~np.isfinite(G))[0, 0])
        raise ValueError(f"`frf` must be finite. Got a NaN or infinity in row {k}.")
    if not G.any():
        raise ValueError(
            "`frf` must not be zero at all frequencies: nothing tells the parameters "
            "then. Got zeros only."
        )
    largest = float(np.abs(G).max(initial=0.0))
    if not SMALLEST < largest < LARGEST:
        raise ValueError(
            f"`frf` must be of a size from {SMALLEST:g} to {LARGEST:g}. Got "
            f"{largest:.3g}; take another unit."
        )
    return grid, G.reshape(len(grid), n_outputs, n_inputs).astype(complex)


def read_noise(
    noise: ArrayLike | None, coherence: ArrayLike | None, n_averages: Any, G: Complex
) -> Array | None:
    """Standard deviations of the entries of a response `G`; None where none are told.

    Of the whole complex error: its real part has half of the variance. From a coherence
    of so many independent averages, ``|G| sqrt((1 - c) / (c n))``.
    """
    if noise is None and coherence is None:
        return None
    if noise is not None and coherence is not None:
        raise ValueError(
            "`noise` and `coherence` tell the same thing: give one of them. Got both."
        )
    name, given = ("noise", noise) if coherence is None else ("coherence", coherence)
    values = real_array(name, given)
    shape = values.shape
    if values.ndim == 1:
        values = values[:, None, None]
    k, p, m = G.shape
    known = values.ndim == 3 and values.shape in ((k, 1, 1), G.shape)
    least, most = _LEAST, 1.0 / _LEAST if coherence is None else 1.0
    if not known or not ((values > least) & (values <= most)).all():
        rule = f"above {least:g}, and {most:g} at most"
        raise ValueError(
            f"`{name}` must have shape ({k},) or ({k}, {p}, {m}), with values {rule}. "
            f"Got shape {shape}."
        )
    if coherence is not None:
        whole_number("n_averages", n_averages, 1, _MOST_AVERAGES)
        open_ = np.maximum(1.0 - values, _LEAST_INCOHERENCE)
        # of an entry that happens to be small, as that of its size over frequency
        size = np.maximum(np.abs(G), _LEAST_INCOHERENCE * np.abs(G).max())
        values = size * np.sqrt(open_ / values / n_averages)
    return np.broadcast_to(values, G.shape)
