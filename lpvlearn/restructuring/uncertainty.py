"""What a response tells of the parameters: which ones, and how exactly.

To first order the derivative J of the response carries its errors to the parameters;
its rank tells which of them it determines at all. Where the response is not linear
within these errors, that is told, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..models.statespace import StateSpace
from ..systems.least_squares import column_scale
from .identifiability import Identifiability, sparse_rows, undetermined_steps
from .least_squares import channel_scaling, least_maximum
from .problem import RestructuringProblem
from .similarity import bilinear_changes
from .singular_points import Bend, bend_of, squared_combinations

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_ROUNDING = 1e-10  # relative change of a response that is none: a step's end

# Parameters whose own size changes the response by a smaller part are next to zero; and
# the part of a promised change that tells a linear response.
_ZERO, _LINEAR = 1e-3, 0.5

# Relative step that tells how the response bends, and one of which rounding would tell
_LOCAL, _TOO_SHORT = 0.1, 1e-3
_KNOWN = 1e-2  # relative standard deviation of a parameter that is known well enough


class ParameterUncertainty:
    """Of the parameters `theta` of a problem, (n_params,), from its response there."""

    def __init__(self, problem: RestructuringProblem, theta: Array) -> None:
        self.problem, self.theta = problem, theta
        structure = problem.structure
        self._names = structure.parameter_names
        self._bounds = structure.lower, structure.upper
        self._response, self._jacobian = problem.system.response_jacobian(
            theta, problem.omega
        )

    def identifiability(self) -> Identifiability:
        """Which parameters the response determines, and how well."""
        J, level, _ = self._relative_changes
        return Identifiability.from_jacobian(J, self._names, level)

    def open_variances(self) -> Array:
        """Infinite on the diagonal for parameters that the response leaves open.

        That is where a combination of those that no bound holds does not change it.
        """
        J, level, _ = self._relative_changes
        free = self._free_jacobian.any(axis=(0, 1, 2))
        names = np.array(self._names)
        found = Identifiability.from_jacobian(J[..., free], names[free].tolist(), level)
        left_open = {name for direction in found.directions for name in direction}
        return np.diag(np.where(np.isin(names, list(left_open)), np.inf, 0.0))

    def changes(self, dG: Complex, norm: str) -> Array:
        """First-order changes of the parameters, (r, n_params), with the black box's.

        Of those that minimise Eq. (7) for the norm "similarity", else the weighted mean
        square error, ``d theta = Re(K dG)`` with ``K = (J^T J)^-1 J^H W`` in real
        arithmetic, over the grid or, for "h2", over frequencies as its integral counts
        them. `dG` (r, k, n_outputs, n_inputs) are changes of the response; several
        black boxes change alike.
        """
        problem = self.problem
        if norm == "similarity":
            assert problem.box is not None  # it was minimised
            structure, box, omega = problem.structure, problem.box, problem.omega
            return bilinear_changes(structure, box, self.theta, omega, dG)
        W = problem.weight
        if norm == "h2":
            W = np.sqrt(np.gradient(problem.omega))[:, None, None] * W
        WJ = np.einsum("kpq,kqmj->kpmj", W, self._columns)
        flat = WJ.reshape(-1, WJ.shape[-1])
        columns = np.vstack([flat.real, flat.imag])
        unit = column_scale(columns)
        inverse = np.linalg.pinv(columns / unit) / unit[:, None]
        real, imaginary = np.split(inverse, 2, axis=1)
        K = (real + 1j * imaginary).reshape(-1, *WJ.shape[:-1])
        K = np.einsum("jkpm,kpq->jkqm", K, W.conj())
        if K.shape[2] != dG.shape[2]:  # several black boxes were stacked
            K = K.reshape(*K.shape[:2], -1, *dG.shape[2:]).sum(2)
        K = K[: len(self.theta)]
        return np.asarray(np.einsum("jkpm,rkpm->rj", K.conj(), dG).real)

    def covariance_of_runs(self, models: Sequence[StateSpace], norm: str) -> Array:
        """Covariance of the parameters of an averaged model from single realizations.

        That of their mean is that of one divided by their number.
        """
        G = np.array([self.problem.response_of(model) for model in models])
        return self.covariance((G - G.mean(0)) / np.sqrt(len(G)), norm)

    def covariance_of_noise(self, draws: int, seed: int) -> Array:
        """Covariance of the parameters of a response with noise, from so many draws."""
        problem = self.problem
        rng = np.random.default_rng(seed)
        real, imaginary = rng.normal(size=(2, draws, *problem.response.shape))
        noise = problem.noise * np.sqrt(0.5) * (real + 1j * imaginary)
        return self.covariance(noise, "hinf")

    def covariance(self, noise: Complex, norm: str) -> Array:
        """Covariance of the parameters that minimise `norm`, from draws of the noise.

        In the linearised structure: the least maximum for "hinf", which is not linear
        in the noise, else as `changes`; with `open_variances`.
        """
        count = len(self.theta)
        if norm != "hinf":
            moved = self.changes(noise, norm)
        else:
            W = self.problem.weight
            WJ = np.einsum("kpq,kqmj->kpmj", W, self._columns)
            copies = W.shape[2] // noise.shape[2]  # of several black boxes
            dE = W @ np.tile(noise, (1, 1, copies, 1))
            # what the noise does not explain of the error is there with any noise
            E = self.problem.system.weighted_error(self.theta, self.problem.omega)
            variance = np.sum(np.abs(dE) ** 2) / (len(dE) - 1)
            explained = variance / max(float(np.sum(np.abs(E) ** 2)), 1e-300)
            E = E * np.sqrt(max(1.0 - explained, 0.0))
            moved = np.array([least_maximum(E - part, WJ) for part in dE])[:, :count]
        covariance = np.cov(moved.T, ddof=1).reshape(count, -1)
        return covariance + self.open_variances()

    def not_linear(self, covariance: Array) -> list[str]:
        """Parameters whose intervals are not those of a linear model.

        A parameter is moved by two standard deviations to either side, and the others
        as they go with it: the response there, taken for a linear one, moves it by as
        much to both, and not by half of it more or less. That of two parts that are
        nearly alike does not: it is even in their difference. Parameters known to a
        hundredth are known, whatever the others do to them.
        """
        lower, upper = self._bounds
        sizes = self._relative_changes[2]
        # Part of a step that tells how it bends: a long one may saturate.
        room = np.minimum(self.theta - lower, upper - self.theta)
        room = np.minimum(room, _LOCAL * sizes)
        with np.errstate(all="ignore"):
            std = np.sqrt(np.diag(covariance))
            steps = 2.0 * covariance / std
            ratios = np.where(steps.T, room, np.inf) / np.abs(steps.T)
            parts = np.minimum(1.0, np.min(ratios, axis=1))
            lengths = parts * np.max(np.abs(steps.T) / sizes, axis=1)
        known = np.isfinite(std) & (std > _KNOWN * sizes)
        some = np.flatnonzero(known & (lengths > _TOO_SHORT))
        bends = {j: self._bend(parts[j] * steps[:, j]) for j in some}
        even = {j: 0.5 * found for j, found in bends.items() if found is not None}
        if not even:
            return []
        moved = self.changes(np.array(list(even.values())), "hinf")
        return [
            self._names[j]
            for j, row in zip(even, moved, strict=True)
            if abs(row[j]) > _LINEAR * parts[j] ** 2 * 2.0 * std[j]
        ]

    @cached_property
    def _bend(self) -> Bend:
        return bend_of(self._response_at, self.theta, *self._bounds)

    def _response_at(self, theta: Array) -> Complex:
        return self.problem.system.response(theta, self.problem.omega)

    @cached_property
    def _relative_changes(self) -> tuple[Complex, Array, Array]:
        """Of the response by relative steps, its sizes, and those of the parameters."""
        G, J, theta = self._response, self._jacobian, self.theta
        scaling = channel_scaling(self.problem.response)
        if scaling is not None:  # a faint channel tells parameters, too
            G, J = G * scaling, J * scaling[..., None]
        level = np.linalg.norm(G, axis=(1, 2))
        usual = float(np.sqrt(np.mean(level**2)))
        effect = np.sqrt(np.sum(np.abs(J) ** 2, axis=(0, 1, 2)) / len(J))
        sizes = np.where(theta == 0, 1.0, np.abs(theta))
        # Next to zero, where the response is linear in a parameter, its errors count
        # against what would matter: most zeros are meant to be zeros.
        faint = (effect > 0) & (effect * np.abs(theta) < _ZERO * usual)
        for j in np.flatnonzero(faint):
            step = np.zeros(len(theta))
            step[j] = (-1.0 if theta[j] < 0 else 1.0) * usual / effect[j]
            with np.errstate(all="ignore"):  # there need not be a model
                moved = self._response_at(theta + step)
                moved = moved if scaling is None else moved * scaling
                change = np.sqrt(np.sum(np.abs(moved - G) ** 2) / len(G))
            if change > _LINEAR * usual:
                sizes[j] = abs(step[j])
        return J * sizes, level, sizes

    @cached_property
    def _free_jacobian(self) -> Complex:
        """Derivative of the response; zero by parameters that their bounds hold.

        That is where the way to the bound changes the response by rounding.
        """
        lower, upper = self._bounds
        way = np.minimum(self.theta - lower, upper - self.theta)
        effect = np.linalg.norm(self._jacobian.reshape(-1, len(way)), axis=0)
        with np.errstate(invalid="ignore"):  # no bound, and no effect
            held = way * effect <= _ROUNDING * np.linalg.norm(self._response)
        return np.where(held, 0.0, self._jacobian)

    @cached_property
    def _columns(self) -> Complex:
        """Derivatives of the response, and columns of `squared_combinations`."""
        J, count = self._free_jacobian, len(self.theta)
        relative, level, sizes = self._relative_changes
        free = J.any(axis=(0, 1, 2))
        rows = sparse_rows(undetermined_steps(relative[..., free], level))
        if not len(rows):
            return J
        steps = np.zeros((len(rows), count))
        steps[:, free] = rows * sizes[free]
        size = float(np.linalg.norm(self.problem.response))
        flat = J.reshape(-1, count)
        found = squared_combinations(flat, steps, sizes, self._bend, size)
        return np.concatenate([J, found.reshape(*J.shape[:3], -1)], axis=3)
