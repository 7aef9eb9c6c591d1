"""The error of a structure against a measured frequency response."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .hinf import PeakSet
from .matching import ErrorSystem, Structure
from .transfer import Target, model_derivatives

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BESIDE = 1e-3  # relative difference of measured neighbours that are equally high


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
        target = Target(empty, np.zeros((0, n_inputs)), np.zeros((n_outputs, 0)), D)
        super().__init__(structure, target)
        order = np.argsort(omega)
        self.omega, self.G = omega[order], G[order]
        self.fastest = float(self.omega[-1])
        unit = np.broadcast_to(np.eye(n_outputs), (len(omega), n_outputs, n_outputs))
        self.W = (unit if weight is None else weight[order]).astype(complex)

    def restructured(self, structure: Structure) -> ErrorSystem:
        """The error of another structure."""
        return MeasuredErrorSystem(structure, self.omega, self.G, self.W)

    def reweighted(self, weight: Target) -> ErrorSystem:
        """The same error behind one more weight (a scalar one)."""
        factor = model_derivatives(weight, self.omega)[0][:, :1, :1]
        return MeasuredErrorSystem(self.structure, self.omega, self.G, factor * self.W)

    def resonances(self, poles: Complex) -> Array:
        """None: no frequency lies between the measured ones."""
        return np.zeros(0)

    def weight_response(self, omega: Array) -> tuple[Complex, Complex, Complex]:
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
