"""What a table must offer before a model can be identified from it."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from .exceptions import RankWarning
from .numerics.identification import max_horizon, max_order

Array = NDArray[np.float64]
Pairs = list[tuple[Array, Array]]

# Relative singular value below which inputs count as collinear.
_COLLINEAR = 1e-10


def constant_inputs(inputs: Sequence[Array]) -> NDArray[np.intp]:
    """Inputs that have one and the same value in all samples of all experiments.

    Parameters
    ----------
    inputs : sequence of ndarray of shape (n_samples, n_inputs)
        One per experiment.

    Returns
    -------
    ndarray of int
        Their column numbers.

    Examples
    --------
    >>> import numpy as np
    >>> constant_inputs([np.array([[1.0, 2.0], [3.0, 2.0]])])
    array([1])
    """
    low = np.min([u.min(axis=0) for u in inputs], axis=0)
    high = np.max([u.max(axis=0) for u in inputs], axis=0)
    return np.flatnonzero(low == high)


def independent_inputs(inputs: Sequence[Array]) -> Array | None:
    """Combinations that make collinear inputs independent.

    Parameters
    ----------
    inputs : sequence of ndarray of shape (n_samples, n_inputs)
        One per experiment; no column zero.

    Returns
    -------
    ndarray of shape (n_inputs, rank) or None
        P such that the columns of ``u P`` are independent; a model of these inputs
        with input matrix ``B`` is the smallest one of the original inputs with
        ``B P.T``, inputs scaled to their largest value. None where the inputs are
        independent as they are, or the samples too few to tell.

    Examples
    --------
    >>> import numpy as np
    >>> u = np.array([[1.0], [2.0], [-1.0]])
    >>> independent_inputs([u]) is None
    True
    >>> independent_inputs([np.hstack([u, u])]).shape
    (2, 1)
    """
    stacked = np.vstack(inputs)
    n_samples, n_inputs = stacked.shape
    scale = np.abs(stacked).max(axis=0)
    gram = stacked / scale
    # Rounding of the Gram matrix hides ratios below 1e-8: only a suspicion is checked
    # on the samples themselves.
    values = np.linalg.eigvalsh(gram.T @ gram)
    if n_samples < n_inputs or values[0] > 1e-12 * values[-1]:
        return None
    _, s, right = np.linalg.svd(np.linalg.qr(gram)[1])
    rank = int(np.sum(s > _COLLINEAR * s[0]))
    return None if rank == n_inputs else (right[:rank] / scale).T


def check_excitation(pairs: Pairs, names: Sequence[Hashable] | None = None) -> None:
    """Refuse a single sample and inputs that never change.

    Parameters
    ----------
    pairs : list of (u, y)
        Arrays (n_samples, n_inputs) and (n_samples, n_outputs), one per experiment.
    names : sequence, default=None
        Of the inputs; None numbers them.

    Raises
    ------
    ValueError
    """
    inputs = [u for u, _ in pairs]
    if max(len(u) for u in inputs) < 2:
        raise ValueError(
            "A dynamic model needs an experiment of at least 2 samples. Got n_samples "
            f"= {len(inputs)} in {len(inputs)} experiment(s) of 1 sample."
        )
    constant = constant_inputs(inputs)
    if len(constant):
        k = constant[0]
        raise ValueError(
            f"Every input must vary. Got input {k if names is None else names[k]!r} "
            f"constant at {inputs[0][0, k]:g}: "
            "its effect cannot be told from the initial state. Leave it out of "
            "`inputs` or excite it."
        )


def reduce_inputs(pairs: Pairs) -> tuple[Pairs, Array]:
    """Replace collinear inputs by independent combinations of them, and say so.

    Parameters
    ----------
    pairs : list of (u, y)

    Returns
    -------
    pairs : list of (u, y)
    basis : ndarray of shape (n_inputs, rank)
        The input matrix in the original inputs is that of the new ones times
        ``basis.T``; the identity in the usual case.

    Warns
    -----
    RankWarning
        If inputs are collinear.
    """
    n_inputs = pairs[0][0].shape[1]
    basis = independent_inputs([u for u, _ in pairs])
    if basis is None:
        return pairs, np.eye(n_inputs)
    warnings.warn(
        f"The {n_inputs} inputs are collinear (rank {basis.shape[1]}): their separate "
        "effects are not identifiable and the smallest solution was taken. Excite the "
        "inputs independently.",
        RankWarning,
        stacklevel=5,
    )
    return [(u @ basis, y) for u, y in pairs], basis


def check_size(
    pairs: Pairs, order: int | None, horizon: int | None, method: str
) -> None:
    """Refuse a horizon or an order that the number of samples cannot carry.

    Parameters
    ----------
    pairs : list of (u, y)
    order, horizon : int or None
        None is still to be chosen.
    method : str
        As in `SubspaceLTI`.

    Raises
    ------
    ValueError
    """
    lengths = [len(u) for u, _ in pairs]
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    longest = max_horizon(lengths, n_inputs, n_outputs)
    if horizon is not None and horizon > longest:
        raise ValueError(
            f"`horizon` must be at most {longest} for {sum(lengths)} samples of "
            f"{n_inputs} input(s) and {n_outputs} output(s). Got {horizon}. Use "
            "horizon='auto' or more samples."
        )
    used = longest if horizon is None else horizon
    highest = max_order(used, n_inputs, n_outputs, method)
    if order is not None and order > highest:
        raise ValueError(
            f"`order` must be at most {highest} for {sum(lengths)} samples and horizon "
            f"{used}. Got {order}."
        )
