"""Linear least squares with scaled columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]

# Directions of the normalised regressors below this are left out (minimum norm): what
# remains of sixteen digits after the squaring of a condition number in a Gram matrix.
RCOND = 1e-11


def scaled_lstsq(M: Array, rhs: Array, rcond: float = RCOND) -> tuple[Array, int]:
    """Least squares with columns scaled to one, minimum norm where rank deficient.

    Parameters
    ----------
    M : ndarray of shape (n_rows, n_unknowns)
    rhs : ndarray of shape (n_rows,) or (n_rows, n_runs)
    rcond : float
        Relative singular value below which a direction counts as undetermined.

    Returns
    -------
    solution : ndarray of shape (n_unknowns,) or (n_unknowns, n_runs)
    rank : int
    """
    if M.shape[1] == 0:
        return np.zeros((0, *rhs.shape[1:])), 0
    scale = np.sqrt(np.einsum("ij,ij->j", M, M))
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = linalg.lstsq(
        M / scale, rhs, cond=rcond, lapack_driver="gelsy", check_finite=False
    )
    return (solution.T / scale).T, int(rank)
