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

from collections.abc import Callable, Sequence
from math import prod

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, schur
from scipy.linalg.lapack import dtrsyl
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ..models.scheduling_range import in_range_of_points
from ..models.statespace import StateSpace
from ..systems.balancing import gramian_factor
from ..systems.least_squares import Rows, levenberg_marquardt

Array = NDArray[np.float64]
Places = NDArray[np.int32]

_DIGITS = 9  # of distances from the middle, beyond which they are equal

_APART = 1e-9  # of points at one place: a graph takes a distance of zero for none

# Rates at which states are forgotten, by the modulus of the reference's fastest pole.
_FORGOTTEN = (0.0, 1e-3, 1e-2, 0.1, 1.0)

_SMALL = 1e-12  # part of a cost by which no fall is worth another step
_STEPS = 100  # neighbours take ten; models that are no neighbours have no nearest basis

# Of the derivatives of models that are turned at once
_NUMBERS = 2**20


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


def spanning_tree(kappa: Array, *, outward: bool = True) -> tuple[Places, Places]:
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
    at_once, found = max(1, _NUMBERS // reference.order**4), []
    for i in range(0, len(models), at_once):
        some = models[i : i + at_once]
        correlations = [_correlations(m, reference, form, rates) for m in some]
        U, _, Vt = np.linalg.svd(np.array(correlations))
        found += [*_Distance(some, reference, weight).nearest(U @ Vt)]
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

    K is skew-symmetric, with the unknowns k above its diagonal (Cayley's transform). Of
    several models, all of them at once.
    """

    def __init__(
        self, models: Sequence[StateSpace], reference: StateSpace, root: Array
    ) -> None:
        self.models = [np.array([getattr(m, M) for m in models]) for M in "ABC"]
        self.reference, self.root = reference, root
        self.above = np.triu_indices(reference.order, 1)

    def nearest(self, starts: Array) -> Array:
        """T of every model at the minimum that the best of its starts leads to."""
        n_models, n_starts, n, _ = starts.shape
        rows = np.repeat(np.arange(n_models), n_starts)
        lengths = np.linalg.norm(
            self.residuals(*self.turned(rows, starts.reshape(-1, n, n))), axis=1
        )
        best = lengths.reshape(n_models, n_starts).argmin(axis=1)
        start = starts[range(n_models), best]

        def residuals(k: Array, rows: Rows) -> tuple[Array, Callable[[Rows], Array]]:
            turn, inverse = self.turn(k)
            now = self.turned(rows, start[rows] @ turn)

            def jacobian(kept: Rows) -> Array:
                return self.jacobian(*(M[kept] for M in (*now, inverse)))

            return self.residuals(*now), jacobian

        unknowns = np.zeros((n_models, len(self.above[0])))
        found = levenberg_marquardt(
            residuals, unknowns, max_iter=_STEPS, tol=_SMALL, patience=1
        )
        return np.asarray(start @ self.turn(found.x)[0])

    def turned(self, rows: Rows, T: Array) -> tuple[Array, Array, Array]:
        """A, B and C of some models in other bases."""
        (A, B, C), back = (M[rows] for M in self.models), T.swapaxes(-1, -2)
        return back @ A @ T, back @ B, C @ T

    def residuals(self, A: Array, B: Array, C: Array) -> Array:
        """Differences from the reference as rows of residuals, weighed."""
        known = self.reference
        return self._stacked(A - known.A, B - known.B, C - known.C)

    def _stacked(self, A: Array, B: Array, C: Array) -> Array:
        parts = (A @ self.root, self.root @ A, B, C)
        rows = [M.reshape(*M.shape[:-2], prod(M.shape[-2:])) for M in parts]
        return np.concatenate(rows, axis=-1)

    def turn(self, k: Array) -> tuple[Array, Array]:
        """(I - K)^-1 (I + K), and (I - K)^-1."""
        K = np.zeros((len(k), *self.root.shape))
        K[:, *self.above] = k
        K -= K.swapaxes(1, 2)
        eye = np.eye(len(self.root))
        inverse = np.asarray(np.linalg.inv(eye - K), float)
        return inverse @ (eye + K), inverse

    def jacobian(self, A: Array, B: Array, C: Array, inverse: Array) -> Array:
        """A change of K turns T on by the skew W = 2 (I + K)^-1 dK (I - K)^-1."""
        row, column = self.above
        half = inverse[:, row, :, None] * inverse[:, column, None, :]
        W = 2.0 * (half - half.swapaxes(-1, -2))
        A, B, C = (M[:, None] for M in (A, B, C))
        return self._stacked(A @ W - W @ A, -W @ B, C @ W).swapaxes(1, 2)
