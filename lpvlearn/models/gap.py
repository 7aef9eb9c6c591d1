"""The nu-gap between models, by normalised coprime factors.

A model is the graph of its inputs and outputs, ``[y; u] = G v`` with right factors
``G = [N; M]``, ``P = N M^-1``, ``G* G = I``; left ones ``K = [-M, N]`` vanish on it,
``K G = 0``, ``K K* = I``. How far the graph of one is from that of another is the norm
of ``K_2 G_1``, provided that the two turn about each other as often as they have
unstable poles: that ``G_2* G_1``, stable but for the order of P_2, has an inverse of
that kind too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_continuous_are, solve_discrete_are

from ..exceptions import warn
from ..systems.hinf_norm import linf_norm
from ..systems.response import equilibrated, frequency_response
from ..systems.sampling import d2c_tustin
from ..systems.threads import one_blas_thread
from .statespace import StateSpace

Array = NDArray[np.float64]

_LOST = 1e-4  # error of coprime factors, of which the gap has no more digits

_HIDDEN = 1e-12  # of the matrices, what is left where inputs do not reach a state

_ORTHOGONAL = 1.0 - 1e-12  # a norm of 1 but for rounding: somewhere the graphs are


@one_blas_thread
def gap(G1: StateSpace, G2: StateSpace) -> float:
    r"""The nu-gap: how far two models are apart for whoever closes a loop around them.

    .. math:: \delta_\nu(G_1, G_2) = \sup_\omega \bar\sigma\left(
        (I + G_2 G_2^*)^{-1/2} (G_1 - G_2) (I + G_1^* G_1)^{-1/2} \right)

    provided that :math:`\det(I + G_2^* G_1)` has no zero on the axis and winds about 0
    as often as the unstable poles of the two demand; else 1.

    Parameters
    ----------
    G1, G2 : StateSpace
        Of the same inputs, outputs and sampling time, in continuous or discrete time;
        stable or not, integrators too. Delays must be the same; in discrete time they
        may differ.

    Returns
    -------
    float
        Between 0, of models with the same transfer function, and 1.

    Raises
    ------
    ValueError
        If the models do not fit together, delays differ in continuous time, or an
        unstable state is not reached by the inputs or not seen in the outputs.

    Warns
    -----
    UserWarning
        If digits are lost, as of models with tens of unstable poles.

    Notes
    -----
    A controller that keeps G1 stable with the margin b keeps every G2 stable whose
    gap is below b, with the margin ``b - gap`` at least (up to the arc sines). Unstable
    models may be near to one another, and a stable one to an unstable one: ``1/s`` and
    ``1/(s - 0.01)`` are.

    The gap depends on the units of inputs and outputs: a gain counts as large where
    it is above 1. Scale the models to what is large in their signals first.

    It is the L-infinity norm of a product of normalised coprime factors, with the
    accuracy of :meth:`StateSpace.hinf_norm` and that of two Riccati equations.

    References
    ----------
    G. Vinnicombe, Frequency domain uncertainty and the graph topology. IEEE
    Transactions on Automatic Control 38, 1993.

    Examples
    --------
    Two integrators of gains a and b are ``|a - b| / (a + b)`` apart:

    >>> from lpvlearn import StateSpace, gap
    >>> round(gap(StateSpace(0, 1, 1), StateSpace(0, 1, 3)), 9)
    0.5
    >>> round(gap(StateSpace(0, 1, 1), StateSpace(0.01, 1, 1)), 4)
    0.01
    """
    P1, P2 = _without_delay(G1, G2)
    first, second = _right_factors(P1), _right_factors(P2)
    dt, annihilator = 1.0 if P1.discrete else None, _annihilator(P2)
    found = linf_norm(*_product(annihilator, first), dt=dt)
    _tell_lost_digits((first, annihilator), found.frequencies[:1], dt)
    if found.norm >= _ORTHOGONAL or not _winds_as_it_must(first, second):
        return 1.0
    return float(found.norm)


class _System(NamedTuple):
    """Matrices, and whether time is discrete."""

    A: Array
    B: Array
    C: Array
    D: Array
    discrete: bool


def _without_delay(G1: StateSpace, G2: StateSpace) -> tuple[_System, _System]:
    """Both models without what acts on the inputs of both alike."""
    for name, model in (("G1", G1), ("G2", G2)):
        if not isinstance(model, StateSpace):
            raise ValueError(
                f"`{name}` must be a StateSpace. Got {type(model).__name__}."
            )
    pair = [G1.with_input_delay(0), G2.with_input_delay(0)]
    pair[0] - pair[1]  # refuses other inputs, outputs and sampling times
    if not np.array_equal(G1.input_delay, G2.input_delay):
        if G1.is_continuous:
            raise ValueError(
                "`gap` needs models of the same `input_delay` in continuous time. Got "
                f"{G1} and {G2}. Sample both by to_discrete(sampling_time), or compare "
                "what is left of them by with_input_delay(0)."
            )
        pair = [G1.absorb_delay(), G2.absorb_delay()]
    rate = 1.0
    if G1.is_continuous:  # Riccati equations in units of the poles
        size = np.abs(np.concatenate([model.poles() for model in pair]))
        size = size[size > 0]
        rate = float(np.exp(np.log(size).mean())) if len(size) else 1.0
    found = []
    for model in pair:
        A, B, C = model.A / rate, model.B / rate, model.C
        if model.order:
            A, B, C = equilibrated(A, B, C)
        found.append(_System(A, B, C, model.D, not G1.is_continuous))
    return found[0], found[1]


def _right_factors(P: _System) -> _System:
    """``G = [N; M]``, stable, with ``P = N M^-1`` and ``G* G = I``."""
    A, B, C, D, discrete = P
    R, F = np.eye(B.shape[1]) + D.T @ D, np.zeros((B.shape[1], 0))
    if len(A):
        solve = solve_discrete_are if discrete else solve_continuous_are
        try:
            if _hides_unstable(A, B, discrete) or _hides_unstable(A.T, C.T, discrete):
                raise LinAlgError
            X = solve(A, B, C.T @ C, R, s=C.T @ D)
        except LinAlgError:
            raise ValueError(
                "`gap` needs models whose unstable states are reached by the inputs "
                f"and seen in the outputs. Got one of {len(A)} states that no "
                "feedback stabilises: remove those that are hidden."
            ) from None
        R = R + B.T @ X @ B if discrete else R
        F = -np.linalg.solve(R, D.T @ C + B.T @ (X @ A if discrete else X))
    root = np.linalg.inv(np.linalg.cholesky(R)).T
    outputs, feedthrough = np.vstack([C + D @ F, F]), np.vstack([D, np.eye(len(F))])
    return _System(A + B @ F, B @ root, outputs, feedthrough @ root, discrete)


def _hides_unstable(A: Array, B: Array, discrete: bool) -> bool:
    """Whether a mode that does not decay is out of reach, by Hautus's test."""
    poles = np.linalg.eigvals(A)
    size = np.linalg.norm(np.hstack([A, B]))
    lasting = np.abs(poles) - 1.0 if discrete else poles.real
    return any(
        np.linalg.svd(np.hstack([A - pole * np.eye(len(A)), B]), compute_uv=False)[-1]
        < _HIDDEN * size
        for pole in poles[lasting > -_HIDDEN * size]
    )


def _annihilator(P: _System) -> _System:
    """``K = [-M, N]``, stable, with ``P = M^-1 N`` and ``K K* = I``."""
    A, C, B, D, discrete = _right_factors(
        _System(P.A.T, P.C.T, P.B.T, P.D.T, P.discrete)
    )
    n_inputs = P.D.shape[1]

    def turned(M: Array) -> Array:
        N, M = np.split(M.T, [n_inputs], axis=1)
        return np.hstack([-M, N])

    return _System(A.T, turned(B), C.T, turned(D), discrete)


def _product(G: _System, H: _System) -> tuple[Array, Array, Array, Array]:
    """Matrices of the series ``G H``."""
    A = np.block([[G.A, G.B @ H.C], [np.zeros((len(H.A), len(G.A))), H.A]])
    B, C = np.vstack([G.B @ H.D, H.B]), np.hstack([G.C, G.D @ H.C])
    return A, B, C, G.D @ H.D


def _tell_lost_digits(
    factors: tuple[_System, _System], omega: Array, dt: float | None
) -> None:
    """Warn of factors whose gains, all of them one, are not.

    Riccati equations have large solutions where a model of many unstable poles is
    hardly to be stabilised.
    """
    lost = 0.0
    for A, B, C, D, _ in factors:
        gains = np.linalg.svd(
            frequency_response(A, B, C, D, omega, dt=dt), compute_uv=False
        )
        lost = max(lost, np.abs(gains - 1.0).max(initial=0.0))
    if lost > _LOST:
        warn(
            "One of the models is so hard to stabilise that normalised coprime factors "
            f"of it are exact to {lost:.1g} only, and the gap no more. Reduce its "
            "order, or scale inputs and outputs so that its gains are about one."
        )


def _winds_as_it_must(G1: _System, G2: _System) -> bool:
    """Whether ``det G_2* G_1``, not 0 on the axis, has as many unstable zeros as poles.

    The poles are those of ``G_2*``, the mirrored ones of G_2; the zeros those of the
    inverse.
    """
    if G1.discrete:  # the unit circle becomes the imaginary axis
        G1, G2 = (_System(*d2c_tustin(*G[:4], 2.0), False) for G in (G1, G2))
    mirrored = _System(-G2.A.T, -G2.C.T, G2.B.T, G2.D.T, False)
    A, B, C, D = _product(mirrored, G1)
    zeros = np.linalg.eigvals(A - B @ np.linalg.solve(D, C))
    return int((zeros.real > 0).sum()) == len(G2.A)
