"""Black boxes of operating points in one state basis, without a structure.

Balanced models have a basis that is unique up to signs where their singular values
differ, and up to rotations where these come together: neighbours are turned to one
another. The states x and x_r of a model and of its reference answer the same white
input with the covariance X, and their outputs weigh initial states alike by Y:

    A X + X A_r^T + B B_r^T = 0,    A^T Y + Y A_r + C^T C_r = 0.

The rotation T whose x = T x_r agrees best with both is the polar factor of X + Y (an
orthogonal Procrustes problem). Neighbours are those of a minimum spanning tree.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_sylvester, svd
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ..models.statespace import StateSpace

Array = NDArray[np.float64]
Rows = NDArray[np.int32]

_APART = 1e-9  # of points at one place: a graph takes a distance of zero for none


def aligned_models(models: Sequence[StateSpace], kappa: Array) -> list[StateSpace]:
    """Stable balanced models of one order, each turned to its neighbour.

    From the point in the middle of `kappa` (n_points, n_scheduling) outward along a
    minimum spanning tree, every variable in units of its range.
    """
    order, parents = spanning_tree(kappa)
    aligned = list(models)
    for k in order[1:]:
        reference = aligned[parents[k]]
        aligned[k] = models[k].transform(rotation_to(models[k], reference).T)
    return aligned


def spanning_tree(kappa: Array, *, outward: bool = True) -> tuple[Rows, Rows]:
    """Points in an order in which each follows its neighbour, and these neighbours.

    From the point in the middle outward, or from the one farthest outside; the
    neighbour of point k is ``parents[k]``.
    """
    span = np.ptp(kappa, axis=0)
    scaled = (kappa - kappa.min(axis=0)) / np.where(span > 0, span, 1.0)
    tree = minimum_spanning_tree(cdist(scaled, scaled) + _APART)
    if outward:
        away = np.linalg.norm(scaled - np.median(scaled, axis=0), axis=1)
    else:
        away = -np.linalg.norm(scaled - scaled.mean(axis=0), axis=1)
    order, parents = breadth_first_order(tree, int(np.argmin(away)), directed=False)
    return order, parents


def rotation_to(model: StateSpace, reference: StateSpace) -> Array:
    """Orthogonal T by which the model's state is nearest to that of the reference.

    Examples
    --------
    >>> import numpy as np
    >>> model = StateSpace([[-1, 2], [-2, -3]], [[1], [0]], [[1, 1]]).balance()
    >>> turned = model.transform([[0, 1], [-1, 0]])
    >>> rotation_to(turned, model).round(9) + 0.0
    array([[ 0.,  1.],
           [-1.,  0.]])
    """
    X = solve_sylvester(model.A, reference.A.T, -model.B @ reference.B.T)
    Y = solve_sylvester(model.A.T, reference.A, -model.C.T @ reference.C)
    U, _, V = svd(X + Y)
    return np.asarray(U @ V)
