"""Black boxes of operating points in one state basis, without a structure.

Where singular values come together balanced models have a basis that is unique up to
rotations, and so have models whose inputs move all states alike, or whose outputs show
them alike. Neighbours are turned to one another, by the orthogonal T that brings the
matrices of a model nearest to those of its reference (subscript r), which is what
interpolation between them asks for:

    min over T:  (|D S^(1/2)|^2 + |S^(1/2) D|^2) / w + |T^T B - B_r|^2 + |C T - C_r|^2,
    D = T^T A T - A_r,    w^2 = tr(A_r S A_r^T) / tr(S).

S is the reference's mean Gramian, which weighs states by what inputs move of them and
outputs show, and w its mean rate: all terms are energies by time.

The minimum is sought from the rotations that agree best with the correlation of the two
states, under one white input and in the outputs of initial states, both forgotten at a
rate s:

    (A - s) X + X (A_r - s)^T + B B_r^T = 0,    (A - s)^T Y + Y (A_r - s) + C^T C_r = 0,

of which the polar factor of X + Y is the nearest T (an orthogonal Procrustes problem).
Modes whose frequency differs by more than their decay lose their correlation without s;
with much of it, only what inputs and outputs meet at once counts. Neighbours are those
of a minimum spanning tree.

Entries of B and C of a balanced model go with the square root of the size of a mode,
which bends without end where that goes through zero. In "input-normal" states it is C
alone that goes through zero, in "output-normal" ones B.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, schur
from scipy.linalg.lapack import dtrsyl
from scipy.optimize import leastsq
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ..models.scheduling_range import in_range_of_points
from ..models.statespace import StateSpace
from ..systems.balancing import gramian_factor

Array = NDArray[np.float64]
Rows = NDArray[np.int32]

_DIGITS = 9  # of distances from the middle, beyond which they are equal

_APART = 1e-9  # of points at one place: a graph takes a distance of zero for none

# Rates at which states are forgotten, by the modulus of the reference's fastest pole.
_FORGOTTEN = (0.0, 1e-3, 1e-2, 0.1, 1.0)

_SMALL = 1e-8  # changes, relative to what is left, from which no step is worth it
_STEPS = 100  # neighbours take ten; models that are no neighbours have no nearest basis


# States of which both Gramians are the Hankel singular values, or one is the identity
STATES = ("balanced", "input-normal", "output-normal")
OUTPUTS = "outputs"
_SHOWN = 30.0  # condition of an output matrix, of states that are all to be seen


def show_all_states(models: Sequence[StateSpace]) -> bool:
    """Whether outputs, in units in which they move alike, may be the states."""
    return all(
        model.n_outputs == model.order > 0 and np.linalg.cond(model.C) < _SHOWN
        for model in models
    )


def aligned_models(
    models: Sequence[StateSpace], kappa: Array, states: str = STATES[0]
) -> list[StateSpace]:
    """Stable balanced models of one order, each turned to its neighbour.

    From the point in the middle of `kappa` (n_points, n_scheduling) outward along a
    minimum spanning tree, every variable in units of its range. The `states` are one of
    `STATES`, the identity in units of the largest singular value of all models; or
    `OUTPUTS`, of models that `show_all_states`: these need not be turned.
    """
    if states == OUTPUTS:
        return [model.transform(model.C) for model in models]
    order, parents = spanning_tree(kappa)
    aligned = list(models)
    if states != STATES[0]:
        largest = max(m.hankel_singular_values().max(initial=0.0) for m in models)
        aligned = [_normal(model, largest, states == STATES[1]) for model in models]
    for k in order[1:]:
        (turn,) = rotations_to([aligned[k]], aligned[parents[k]])
        aligned[k] = aligned[k].transform(turn.T)
    return aligned


def _normal(model: StateSpace, size: float, by_inputs: bool) -> StateSpace:
    """With the Gramian ``size I`` of the inputs, or of the outputs."""
    pair = (model.A, model.B) if by_inputs else (model.A.T, model.C.T)
    L, root = gramian_factor(*pair, discrete=False), np.sqrt(size)
    return model.transform(root * np.linalg.inv(L) if by_inputs else L.T / root)


def spanning_tree(kappa: Array, *, outward: bool = True) -> tuple[Rows, Rows]:
    """Points in an order in which each follows its neighbour, and these neighbours.

    From the point in the middle outward, or from the one farthest outside; the
    neighbour of point k is ``parents[k]``.
    """
    scaled = in_range_of_points(kappa)
    tree = minimum_spanning_tree(cdist(scaled, scaled) + _APART)
    if outward:
        away = np.linalg.norm(scaled - np.median(scaled, axis=0), axis=1)
    else:
        away = -np.linalg.norm(scaled - scaled.mean(axis=0), axis=1)
    first = int(np.argmin(away.round(_DIGITS)))  # of equals, whatever the units
    order, parents = breadth_first_order(tree, first, directed=False)
    return order, parents


def rotations_to(models: Sequence[StateSpace], reference: StateSpace) -> list[Array]:
    """Orthogonal T by which the matrices of each model are nearest to the reference's.

    Examples
    --------
    >>> import numpy as np
    >>> model = StateSpace([[-1, 2], [-2, -3]], [[1], [0]], [[1, 1]]).balance()
    >>> turned = model.transform([[0, 1], [-1, 0]])
    >>> rotations_to([turned], model)[0].round(9) + 0.0
    array([[ 0.,  1.],
           [-1.,  0.]])
    """
    if not reference.order:
        return [np.zeros((0, 0)) for _ in models]
    form = schur(reference.A)
    weight = _weight(reference, form)
    rates = np.abs(reference.poles()).max() * np.array(_FORGOTTEN)
    found = []
    for model in models:
        distance = _Distance(model, reference, weight)
        U, _, Vt = np.linalg.svd(_correlations(model, reference, form, rates))
        starts = U @ Vt
        lengths = np.linalg.norm(distance.residuals(starts), axis=-1)
        found.append(distance.nearest(starts[int(np.argmin(lengths))]))
    return found


def _correlations(
    model: StateSpace, reference: StateSpace, form: tuple[Array, Array], rates: Array
) -> Array:
    """X + Y of the states of two models that forget at each of some rates.

    By Bartels and Stewart, where one Schur form of A_r (`form`) serves all rates.
    """
    (R, U), (S, V), eye = schur(model.A), form, np.eye(model.order)
    driven = -U.T @ model.B @ reference.B.T @ V
    shown = -U.T @ model.C.T @ reference.C @ V
    found = np.empty((len(rates), *eye.shape))
    for k, rate in enumerate(rates):
        pair = R - rate * eye, S - rate * eye
        found[k] = dtrsyl(*pair, driven, tranb="T")[0]
        found[k] += dtrsyl(*pair, shown, trana="T")[0]
    return np.asarray(U @ found @ V.T)


def _weight(reference: StateSpace, form: tuple[Array, Array]) -> Array:
    """S^(1/2) / w^(1/2) of a reference."""
    gramian = _correlations(reference, reference, form, np.zeros(1))[0] / 2.0
    energy, basis = eigh((gramian + gramian.T) / 2.0)
    root = basis * np.sqrt(np.maximum(energy, 0.0)) @ basis.T
    rate = np.linalg.norm(reference.A @ root) / np.linalg.norm(root)
    return np.asarray(root / np.sqrt(rate))


class _Distance:
    """What is minimised, as residuals of rotations T = T_0 (I - K)^-1 (I + K).

    K is skew-symmetric, with the unknowns k above its diagonal (Cayley's transform).
    """

    def __init__(self, model: StateSpace, reference: StateSpace, root: Array) -> None:
        self.model, self.reference, self.root = model, reference, root
        self.above = np.triu_indices(model.order, 1)

    def nearest(self, start: Array) -> Array:
        """T at the minimum that a start leads to."""
        n_unknowns = len(self.above[0])
        if not n_unknowns:
            return start
        found = leastsq(  # least_squares checks for longer than these steps take
            lambda k: self.residuals(start @ self._turn(k)[0]),
            np.zeros(n_unknowns),
            Dfun=lambda k: self._jacobian(start, k),
            full_output=True,  # and so no warning
            col_deriv=True,
            ftol=_SMALL,
            xtol=_SMALL,
            gtol=_SMALL,
            maxfev=_STEPS,
            diag=np.ones(n_unknowns),
        )
        return np.asarray(start @ self._turn(found[0])[0])

    def residuals(self, T: Array) -> Array:
        model, reference, back = self.model, self.reference, T.swapaxes(-1, -2)
        return self._stacked(
            back @ model.A @ T - reference.A,
            back @ model.B - reference.B,
            model.C @ T - reference.C,
        )

    def _stacked(self, A: Array, B: Array, C: Array) -> Array:
        """Differences (..., rows, columns) as rows of residuals, weighed."""
        parts = (A @ self.root, self.root @ A, B, C)
        return np.concatenate([M.reshape(*M.shape[:-2], -1) for M in parts], axis=-1)

    def _turn(self, k: Array) -> tuple[Array, Array]:
        """(I - K)^-1 (I + K), and (I - K)^-1."""
        K = np.zeros_like(self.root)
        K[self.above] = k
        K -= K.T
        eye = np.eye(len(K))
        inverse = np.asarray(np.linalg.inv(eye - K), float)
        return inverse @ (eye + K), inverse

    def _jacobian(self, start: Array, k: Array) -> Array:
        """Rows: a change of K turns T on by W = 2 (I + K)^-1 dK (I - K)^-1, skew."""
        turn, inverse = self._turn(k)
        T = start @ turn
        A, B, C = T.T @ self.model.A @ T, T.T @ self.model.B, self.model.C @ T
        row, column = self.above
        half = inverse[row][:, :, None] * inverse[column][:, None, :]
        W = 2.0 * (half - half.swapaxes(1, 2))
        return self._stacked(A @ W - W @ A, -W @ B, C @ W)
