"""Which parameters a frequency response determines: the rank of its derivative.

A parameter, or a combination of several, that leaves the response as it is cannot be
found from any data. Its name, or the names of all in it, are what a user can act on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from ..systems.least_squares import column_scale, thin_svd

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Singular values smaller than that part of the largest may be rounding, and are below
# the second one, at a few units in the last place. Between them they are where a change
# of the response by its rounding, 1e-13 or, where terms cancel, ten times as much,
# moves a parameter by its own size: a high condition alone is told as such.
_RANK_TOLERANCE, _ZERO = 1e-9, 1e-14
_DIGITS = 1e-12
_NAMED = 0.1  # smaller parts of an undetermined combination would only clutter its name


@dataclass(frozen=True)
class Identifiability:
    """Rank analysis of the derivative of the response to the parameters.

    Attributes
    ----------
    rank : int
        Number of parameter combinations that the response determines.
    n_params : int
    condition : float
        The most by which a relative error of the response (root mean square over
        frequency) may grow into relative errors of the parameters. Below 1 over the
        black box's own relative error all parameters are known. Infinite if the rank is
        deficient.
    directions : tuple of dict
        One for every undetermined combination: relative change by parameter name, the
        largest 1; below 0.1 it is left out.
    sensitivities : dict
        The same as the condition by parameter name.
    """

    rank: int
    n_params: int
    condition: float
    directions: tuple[dict[str, float], ...]
    sensitivities: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.directions:
            by_name = sorted(self.sensitivities, key=self.sensitivities.__getitem__)
            worst = f", most that of {by_name[-1]}" if by_name else ""
            return (
                f"all {self.n_params} parameters are identifiable "
                f"(condition {self.condition:.2g}{worst})."
            )
        parts = [
            " ".join(f"{value:+.2g} {name}" for name, value in direction.items())
            for direction in self.directions
        ]
        return (
            f"the response determines {self.rank} of the {self.n_params} parameters. "
            f"It does not change along: {'; '.join(parts)} (in relative steps). "
            "Fix a parameter of each combination in the template."
        )

    @classmethod
    def from_jacobian(
        cls, J: Complex, names: Sequence[str], level: Array | float = 1.0
    ) -> Identifiability:
        """Analysis of the response Jacobian, (n_freq, n_outputs, n_inputs, n_params).

        `J` holds changes with the steps that errors and directions are relative to,
        `level` (n_freq,) the sizes of the response. The rank is that of columns divided
        by their norms, of rows divided by the size of what they hold: it does not
        depend on units, on parameters that happen to be zero, nor on how far the
        response falls over frequency.

        Examples
        --------
        The gain ``b c`` of a response does not tell ``b`` from ``c``:

        >>> J = np.array([[[[2.0 + 0j, 3.0]]]])  # at b = 3, c = 2
        >>> found = Identifiability.from_jacobian(J * [3.0, 2.0], ["b", "c"], [6.0])
        >>> found.rank, found.directions
        (1, ({'b': 1.0, 'c': -1.0},))
        """
        n = J.shape[-1]
        undetermined = undetermined_steps(J, level)
        rank = n - len(undetermined)
        directions = tuple(
            {
                name: float(value)
                for name, value in zip(names, row, strict=True)
                if abs(value) > _NAMED
            }
            for row in sparse_rows(undetermined)
        )
        # errors of the response are alike at all frequencies
        usual = float(max(np.linalg.norm(level), _DIGITS * np.linalg.norm(J))) or 1.0
        unit, s, Vt = _scaled_svd(J / usual)
        inverse = (Vt / np.maximum(s, 1e-150)[:, None]).T / unit[:, None]
        gains = np.linalg.norm(inverse, axis=1)
        for direction in directions:
            gains[[names.index(name) for name in direction]] = np.inf
        condition = float(np.linalg.norm(inverse, 2)) if rank == n else np.inf
        sensitivities = dict(zip(names, gains.tolist(), strict=True))
        return cls(rank, n, condition, directions, sensitivities)


def undetermined_steps(J: Complex, level: Array | float) -> Array:
    """Relative steps along which a response of that size does not change, by rows."""
    k = len(J)
    level = np.broadcast_to(level, (k,))
    size = np.maximum(level, _DIGITS * np.linalg.norm(J.reshape(k, -1), axis=1))
    unit, s, Vt = _scaled_svd(J / np.where(size > 0, size, 1.0)[:, None, None, None])
    steps = Vt / unit
    with np.errstate(divide="ignore", over="ignore"):  # along zero without end
        moved = _DIGITS * np.sqrt(k) * np.abs(steps).max(1, initial=0.0) / s
    part = s / (s.max(initial=0.0) or 1.0)
    open_ = (part <= _ZERO) | (part <= _RANK_TOLERANCE) & (moved >= 1.0)
    return np.asarray(steps[open_])


def _scaled_svd(J: Complex) -> tuple[Array, Array, Array]:
    """Lengths of the columns (1 for none), singular values and rows of unit ones."""
    n = J.shape[-1]
    flat = J.reshape(int(np.prod(J.shape[:-1])), n)
    # rows of zeros: few frequencies must not hide undetermined combinations
    columns = np.vstack([flat.real, flat.imag, np.zeros((n, n))])
    unit = column_scale(columns)
    _, s, Vt = thin_svd(columns / unit)
    return unit, s, Vt


def sparse_rows(null: Array) -> Array:
    """Basis of the row space, each row with one entry of its own, largest entry 1.

    Combinations that have nothing to do with one another come apart; an orthonormal
    basis would mix them.
    """
    if len(null) == 0:
        return null
    own = qr(null, mode="r", pivoting=True)[1][: len(null)]
    rows = np.linalg.solve(null[:, own], null)
    largest = np.take_along_axis(rows, np.abs(rows).argmax(1)[:, None], 1)
    return (rows / largest).round(12) + 0.0
