"""What a frequency response tells of the parameters: which ones, and how exactly.

Both follow from the derivative J of the response to the parameters: its rank, and to
first order the change of the parameters with the response, ``d theta = Re(K dG)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from .error_system import ErrorSystem

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

# Singular values smaller than that part of the largest are rounding: responses and
# their derivatives are exact to about 1e-13, behind resolvents less so.
_RANK_TOLERANCE = 1e-9

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
        Largest over smallest singular value; relative errors of the response grow into
        the parameters by up to this factor. Infinite or huge if the rank is deficient.
    directions : tuple of dict
        One for every undetermined combination: change by parameter name, in steps that
        have the same effect on the response, the largest 1; below 0.1 it is left out.
    """

    rank: int
    n_params: int
    condition: float
    directions: tuple[dict[str, float], ...]

    def __str__(self) -> str:
        if not self.directions:
            return (
                f"all {self.n_params} parameters are identifiable "
                f"(condition {self.condition:.2g})."
            )
        parts = [
            " ".join(f"{value:+.2g} {name}" for name, value in direction.items())
            for direction in self.directions
        ]
        return (
            f"the response determines {self.rank} of the {self.n_params} parameters. "
            f"It does not change along: {'; '.join(parts)} (in steps of equal effect). "
            "Fix a parameter of each combination in the template."
        )

    @classmethod
    def from_jacobian(cls, J: Complex, names: Sequence[str]) -> Identifiability:
        """Analysis of the response Jacobian.

        Every column is divided by its norm: the analysis does not depend on the units
        of the parameters, nor on parameters that happen to be zero.

        Parameters
        ----------
        J : ndarray of shape (n_freq, n_outputs, n_inputs, n_params)
            Derivatives of the frequency response.
        names : sequence of str

        Returns
        -------
        Identifiability

        Examples
        --------
        The gain ``b c`` of a response does not tell ``b`` from ``c``:

        >>> J = np.array([[[[2.0 + 0j, 3.0]]]])  # at b = 3, c = 2
        >>> found = Identifiability.from_jacobian(J, ["b", "c"])
        >>> found.rank, found.directions
        (1, ({'b': 1.0, 'c': -1.0},))
        """
        n = J.shape[-1]
        flat = J.reshape(int(np.prod(J.shape[:-1])), n)
        # Rows of zeros: few frequencies must not hide undetermined combinations.
        columns = np.vstack([flat.real, flat.imag, np.zeros((n, n))])
        effect = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(effect > 0, effect, 1.0)
        _, s, Vt = np.linalg.svd(columns, full_matrices=False)
        top = float(s.max(initial=0.0))
        rank = int((s > _RANK_TOLERANCE * top).sum())
        directions = tuple(
            {
                name: float(value)
                for name, value in zip(names, row, strict=True)
                if abs(value) > _NAMED
            }
            for row in _sparse_rows(Vt[rank:])
        )
        low = float(s.min(initial=top))
        condition = top / low if low > 0 else np.inf
        return cls(rank, n, condition, directions)


def _sparse_rows(null: Array) -> Array:
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


def response_gain(system: ErrorSystem, theta: Array, omega: Array) -> Complex:
    """First-order change of the parameters with the black box's response.

    Minimising the weighted mean square error, ``d theta = Re(K dG)`` with
    ``K = (J^T J)^-1 J^H W`` in real arithmetic.

    Returns
    -------
    ndarray of shape (n_params, k, n_outputs, n_inputs)
        ``d theta_j = Re sum conj(K_j) dG``.
    """
    W = system.weight_response(omega)[0]
    J = system.response_jacobian(theta, omega)[1]
    WJ = np.einsum("kpq,kqmj->kpmj", W, J)
    q = J.shape[-1]
    flat = WJ.reshape(-1, q)
    real = np.vstack([flat.real, flat.imag])
    inverse = np.linalg.pinv(real)
    half = len(flat)
    K = (inverse[:, :half] + 1j * inverse[:, half:]).reshape(q, *WJ.shape[:-1])
    return np.einsum("jkpm,kpq->jkqm", K, W.conj())


def spread_covariance(
    system: ErrorSystem, theta: Array, omega: Array, responses: Sequence[Complex]
) -> Array:
    """Covariance of the parameters of an averaged model from single realizations.

    Every realization's response is carried to the parameters to first order; the
    covariance of their mean is that of one divided by their number.

    Parameters
    ----------
    responses : sequence of ndarray of shape (k, n_outputs, n_inputs)
        Responses of the models from single realizations.

    Returns
    -------
    ndarray of shape (n_params, n_params)

    Raises
    ------
    ValueError
        If there are fewer than two realizations.
    """
    if len(responses) < 2:
        raise ValueError(
            "`realizations` must be at least 2 models to have a spread. Got "
            f"{len(responses)}."
        )
    G = np.array(responses)
    K = response_gain(system, theta, omega)
    if K.shape[2] != G.shape[2]:  # several black boxes were stacked
        K = K.reshape(*K.shape[:2], -1, G.shape[2], G.shape[3]).sum(2)
    changes = np.real(np.einsum("jkpm,rkpm->rj", K.conj(), G - G.mean(0)))
    return np.cov(changes.T, ddof=1).reshape(len(theta), -1) / len(G)
