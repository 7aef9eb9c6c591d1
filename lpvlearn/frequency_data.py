"""Measured frequency responses as tables: omega, and [Re G, Im G] row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import real_array

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def stack_response(G: Complex) -> Array:
    """(n_freq, n_outputs, n_inputs) to (n_freq, 2 n_outputs n_inputs).

    Examples
    --------
    >>> stack_response(np.array([[[1 + 2j, 3 + 4j]]]))
    array([[1., 3., 2., 4.]])
    """
    flat = G.reshape(len(G), -1)
    return np.hstack([flat.real, flat.imag])


def read_frequency_data(
    omega: ArrayLike, frf: ArrayLike, n_outputs: int, n_inputs: int
) -> tuple[Array, Complex]:
    """Frequencies and complex response, or a ValueError that teaches.

    Parameters
    ----------
    omega : array-like of shape (n_freq,) or (n_freq, 1)
        Angular frequencies, rad/s.
    frf : array-like of shape (n_freq, 2 * n_outputs * n_inputs), or complex of shape
        (n_freq, n_outputs, n_inputs)
        Real parts of the entries row by row, then imaginary parts; or the complex
        response.
    n_outputs, n_inputs : int

    Returns
    -------
    omega : ndarray of shape (n_freq,)
    G : ndarray of shape (n_freq, n_outputs, n_inputs)

    Raises
    ------
    ValueError
        If a shape does not fit, a value is not finite, or a frequency is negative or
        given twice.

    Examples
    --------
    >>> omega, G = read_frequency_data([1.0, 2.0], [[0.5, -0.5], [0.2, -0.4]], 1, 1)
    >>> G[:, 0, 0]
    array([0.5-0.5j, 0.2-0.4j])
    """
    grid = real_array("omega", omega)
    if grid.ndim == 2 and grid.shape[1] == 1:
        grid = grid[:, 0]
    if grid.ndim != 1 or len(grid) == 0:
        raise ValueError(
            "`omega` must have shape (n_freq,) or (n_freq, 1) with n_freq >= 1. "
            f"Got {grid.shape}."
        )
    if not np.isfinite(grid).all() or (grid < 0).any() or not (grid > 0).any():
        raise ValueError("`omega` must be finite, not negative, and not only zero.")
    if len(np.unique(grid)) != len(grid):
        raise ValueError("`omega` must hold every frequency once.")
    table = np.asarray(frf)
    entries = n_outputs * n_inputs
    if np.iscomplexobj(table):
        if table.size != len(grid) * entries or table.shape[:1] != grid.shape:
            raise ValueError(
                f"complex `frf` must have shape ({len(grid)}, {n_outputs}, "
                f"{n_inputs}). Got {table.shape}."
            )
        G = table.reshape(len(grid), n_outputs, n_inputs)
    else:
        table = real_array("frf", frf)
        if table.shape != (len(grid), 2 * entries):
            raise ValueError(
                f"`frf` must have shape ({len(grid)}, {2 * entries}): real parts of "
                f"the {n_outputs} x {n_inputs} entries row by row, then imaginary. "
                f"Got {table.shape}."
            )
        G = (table[:, :entries] + 1j * table[:, entries:]).reshape(
            len(grid), n_outputs, n_inputs
        )
    if not np.isfinite(G).all():
        k = int(np.argwhere(~np.isfinite(G))[0, 0])
        raise ValueError(f"`frf` must be finite. Got a NaN or infinity in row {k}.")
    return grid, G.astype(complex)
