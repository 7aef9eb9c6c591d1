"""Mechanics of the two-link flexible arm, as pure functions on arrays.

In the complex plane, with the absolute angles ``a1 = theta1`` and
``a2 = theta1 + theta2 + 2 l1 v1``, a point of link k at abscissa x lies at
``base_k + exp(i a_k) z(x, v_k)``, where
``z(x, v) = x - (2/3) x^3 v^2 + i x^2 v`` (Eq. (28) of the paper, with the
foreshortening of a bent beam). The principle of virtual power gives
``M = sum m Re(conj(J) J')`` and ``F = -sum m Re(conj(J) a)`` over all masses m,
J the partial derivatives of their positions and a their acceleration at zero
second derivatives of the coordinates. A link enters these sums only through the
moments ``int x^k dm`` of its mass, and every sum is linear in the monomials
``{1, w^2, w v', v'^2} x {1, v, v^2, v^3, v^4}`` of its bending v, its bending rate
v' and its turning rate w = a'. One constant matrix per link therefore holds all of
its mechanics (`_link_table`), and no quadrature remains at run time.

The coordinates are ``r = (a1, v1, a2, v2) = T q`` with ``q = (theta1, theta2, v1,
v2)`` and the constant T of `coordinate_change`, so ``M_q = T' M_r T`` and
``F_q = T' F_r``. Arrays of coordinates are shaped (2 links, 2 kinds, n): kind 0 the
angle, kind 1 the bending, n the number of experiments.

At the end stands the kinematics: what the end-effector of the bent arm does, and the
rigid arm that does the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..validation import real_array

Array = NDArray[np.float64]

ComplexArray = NDArray[np.complexfloating]

# Half the integral of the squared slope: 1/2 int_0^x (2 xi v)^2 dxi = 2/3 x^3 v^2.
_SHORTENING = 2.0 / 3.0

# Monomial (i, j) is the rate i, {1, w^2, w v', v'^2}, times v^j; it stands in column
# _N_POWERS * i + j.
_N_POWERS = 5

_ONE, _TURNING2, _CORIOLIS, _BENDING2 = 0, 1, 2, 3


# Of a step in which the fastest pole turns by 0.7 they leave 1e-9 of the response.
_POINTS = (np.polynomial.legendre.leggauss(6)[0] + 1.0) / 2.0

# Part of the rates by which the accelerations may still change them; each iteration
# takes a tenth or less of what was left.
_CONVERGED, _MOST_ITERATIONS = 1e-10, 40

_HAIR = 1e-9  # a quotient that little below a whole number is that number

_BEYOND = 1e30  # of a coordinate or rate: fifth powers are still numbers


def _link_moments(length: float, density: float, end_mass: float) -> Array:
    """Moments ``int x^k dm`` (kg m^k), k = 0..6, of a uniform link with an end mass.

    `length` in m, `density` in kg/m, `end_mass` in kg.

    Examples
    --------
    >>> _link_moments(1.0, 2.0, 0.5)[:3].round(4)
    array([2.5   , 1.5   , 1.1667])
    """
    k = np.arange(7)
    return density * length ** (k + 1) / (k + 1) + end_mass * length**k


def _link_table(
    moments: Array, lever: Array, hub_inertia: float, conjugate: bool
) -> Array:
    """Matrix from the monomials of one link to its share of M, F and the coupling.

    `moments` are those of everything that moves with the link, `lever` the
    coefficients ``(., x, x^2, x^3)`` of the vector z through which it couples with the
    other link (stored conjugated if `conjugate`), `hub_inertia` in kg m2.

    Rows of the result, (12, 20). 0-3: own mass matrix over (angle, bending), row-major.
    4-5: own Coriolis and centrifugal force. 6-8 and 9-11: real and imaginary parts of
    ``dz/da``, ``dz/dv`` and the acceleration of the lever, in the frame of the link.
    """
    s, m = _SHORTENING, moments
    table = np.zeros((12, 4, _N_POWERS))
    # |z|^2, Im(conj(z) dz/dv) and |dz/dv|^2, integrated
    table[0, _ONE, [0, 2, 4]] = m[2] + hub_inertia, (1 - 2 * s) * m[4], s**2 * m[6]
    table[1, _ONE, [0, 2]] = table[2, _ONE, [0, 2]] = m[3], s * m[5]
    table[3, _ONE, [0, 2]] = m[4], 4 * s**2 * m[6]
    # Half of d|z|^2/dv makes both the Coriolis torque and the centrifugal bending.
    half_slope = (1 - 2 * s) * m[4], 2 * s**2 * m[6]
    table[4, _CORIOLIS, [1, 3]] = -2 * half_slope[0], -2 * half_slope[1]
    table[4, _BENDING2, 1] = -2 * s * m[5]
    table[5, _TURNING2, [1, 3]] = half_slope
    table[5, _BENDING2, 1] = -4 * s**2 * m[6]

    z = np.array([lever[1], 1j * lever[2], -s * lever[3]])
    vectors = np.zeros((3, 4, _N_POWERS), dtype=complex)
    vectors[0, _ONE, :3] = 1j * z
    vectors[1, _ONE, :2] = z[1], 2 * z[2]
    vectors[2, _TURNING2, :3] = -z
    vectors[2, _CORIOLIS, :2] = 2j * z[1], 4j * z[2]
    vectors[2, _BENDING2, 0] = 2 * z[2]
    table[6:9] = vectors.real
    table[9:12] = -vectors.imag if conjugate else vectors.imag
    return table.reshape(12, 4 * _N_POWERS)


def arm_tables(
    l1: float,
    l2: float,
    rho1: float,
    rho2: float,
    J1: float,
    J2: float,
    elbow_mass: float,
    tip_mass: float,
) -> Array:
    """Tables of both links, shape (2, 12, 20): all that M and F need.

    Link 1 carries the whole of link 2 as a point mass at its end, as far as the
    motion of that point goes; the rest is the coupling of the chord of link 1 with
    the first moment of link 2.
    """
    second = _link_moments(l2, rho2, tip_mass)
    first = _link_moments(l1, rho1, elbow_mass + second[0])
    return np.stack(
        [
            _link_table(first, l1 ** np.arange(4.0), J1, conjugate=True),
            _link_table(second, second[:4], J2, conjugate=False),
        ]
    )


def coordinate_change(l1: float) -> Array:
    """Matrix T of ``(a1, v1, a2, v2) = T (theta1, theta2, v1, v2)``."""
    return np.array(
        [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [1.0, 1.0, 2.0 * l1, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def inertial_terms(position: Array, rate: Array, tables: Array) -> tuple[Array, Array]:
    """Mass matrix (4, 4, n), Coriolis and centrifugal forces (2, 2, n) over r.

    `position` and `rate` (2, 2, n) are r and r', `tables` come from `arm_tables`.
    """
    n = position.shape[-1]
    powers = np.empty((2, _N_POWERS, n))
    powers[:, 0] = 1.0
    powers[:, 1] = v = position[:, 1]
    powers[:, 2] = v * v
    powers[:, 3:] = powers[:, 1:3] * powers[:, 2:3]
    rates = np.empty((2, 4, 1, n))
    rates[:, _ONE] = 1.0
    rates[:, _TURNING2::2, 0] = rate * rate
    rates[:, _CORIOLIS, 0] = rate[:, 0] * rate[:, 1]
    monomials = (rates * powers[:, np.newaxis]).reshape(2, 4 * _N_POWERS, n)
    values = tables @ monomials

    # The coupling is Re(conj(J_1) J_2), Re(conj(J_1) a_2) and Re(conj(a_1) J_2).
    vectors = values[:, 6:9] + 1j * values[:, 9:]
    vectors[1] *= np.exp(1j * (position[1, 0] - position[0, 0]))
    coupling = (vectors[0, :, np.newaxis] * vectors[1]).real

    mass = np.empty((4, 4, n))
    own = values[:, :4].reshape(2, 2, 2, n)
    mass[:2, :2] = own[0]
    mass[2:, 2:] = own[1]
    mass[:2, 2:] = coupling[:2, :2]
    mass[2:, :2] = coupling[:2, :2].swapaxes(0, 1)
    force = values[:, 4:6].copy()
    force[0] -= coupling[:2, 2]
    force[1] -= coupling[2, :2]
    return mass, force


def integrate(
    state: Array,
    inputs: Array,
    linear_force: Array,
    tables: Array,
    sampling_time: float,
    step: float,
) -> Array:
    """Integrate several experiments together by collocation at Gauss's points.

    From the initial `state` (8, n), r and r', to the states (n_samples, 8, n) at the
    sampling instants, before the input of that sample acts. `inputs` (n_samples, 4, n)
    are generalised forces due to the velocity references, held over each sample;
    `linear_force` (4, 8) times the state is the elastic and velocity-loop force;
    `tables` come from `arm_tables`. Steps of at most `step` go over as many samples as
    no input changes in; the accelerations at their points are iterated for.
    """
    n = state.shape[1]
    n_samples, n_points = len(inputs), len(_POINTS)
    many = max(1, int(step / sampling_time + _HAIR))  # samples in a step
    n_steps = max(1, int(np.ceil(sampling_time / step - _HAIR)))  # in a sample
    jumps = (np.diff(inputs, axis=0) != 0).any(axis=(1, 2)).nonzero()[0] + 1
    ends = np.append(jumps, n_samples)
    within, at_samples = _integrals(_POINTS), {}
    states = np.empty((n_samples + 1, 8, n))
    states[0] = state
    k = 0
    while k < n_samples:
        m = min(many, ends[np.searchsorted(ends, k, side="right")] - k)
        h = m * sampling_time / n_steps
        if m not in at_samples:
            at_samples[m] = _integrals(np.arange(1, m + 1) / m)
        held, x = np.tile(inputs[k], n_points), states[k]
        for _ in range(n_steps):
            r, rate = x.reshape(2, 4, 1, n)
            rates = np.repeat(rate, n_points, axis=1)
            acceleration = np.zeros_like(rates)
            for _ in range(_MOST_ITERATIONS):
                positions = r + h * (within @ rates)
                both = np.concatenate([positions, rates]).reshape(8, -1)
                mass, force = inertial_terms(
                    both[:4].reshape(2, 2, -1), both[4:].reshape(2, 2, -1), tables
                )
                total = linear_force @ both + held + force.reshape(4, -1)
                before = acceleration
                acceleration = np.linalg.solve(mass.T, total.T[..., np.newaxis])
                acceleration = acceleration[..., 0].T.reshape(rates.shape)
                rates = rate + h * (within @ acceleration)
                change = h * np.abs(acceleration - before).max(axis=(0, 1))
                if (change <= _CONVERGED * np.abs(rates).max(axis=(0, 1))).all():
                    break
            sums = h * (at_samples[m] @ np.concatenate([rates, acceleration]))
            after = (x[:, np.newaxis] + sums).swapaxes(0, 1)
            x = after[-1]
        states[k + 1 : k + m + 1] = after
        k += m
    return states[:-1]


def _integrals(ends: Array) -> Array:
    """Integrals of polynomials from 0 to `ends`, times their values at `_POINTS`."""
    powers = np.arange(1, len(_POINTS) + 1)
    values = (2.0 * _POINTS[:, np.newaxis] - 1.0) ** (powers - 1)
    sums = (2.0 * ends[:, np.newaxis] - 1.0) ** powers - (-1.0) ** powers
    return np.linalg.solve(values.T, (sums / (2.0 * powers)).T).T


def check_coordinates(name: str, value: ArrayLike) -> Array:
    """`value` as a finite array of shape (..., 4)."""
    array = real_array(name, value)
    if array.ndim == 0 or array.shape[-1] != 4:
        raise ValueError(
            f"`{name}` must have shape (..., 4): theta1, theta2, v1, v2. "
            f"Got {array.shape}."
        )
    if not (np.abs(array) < _BEYOND).all():
        raise ValueError(
            f"`{name}` must be finite, smaller than {_BEYOND:g}. Got "
            f"{array.ravel()[~(np.abs(array.ravel()) < _BEYOND)][0]}."
        )
    return array


def _chord(length: float, v: Array) -> tuple[ComplexArray, ComplexArray]:
    """Vector from base to end of a bent link in its frame, and its v-derivative."""
    end = np.asarray(length + 1j * length**2 * v - _SHORTENING * length**3 * v**2)
    slope = np.asarray(1j * length**2 - 2 * _SHORTENING * length**3 * v)
    return end, slope


def rigid_joint_rates(q: Array, qdot: Array, l1: float, l2: float) -> Array:
    """Joint rates (..., 2) of the rigid arm with the same end-effector motion."""
    _, theta2, v1, v2 = np.moveaxis(q, -1, 0)
    rate1, rate2, w1, w2 = np.moveaxis(qdot, -1, 0)
    chord1, slope1 = _chord(l1, v1)
    chord2, slope2 = _chord(l2, v2)
    # Everything is seen in the frame of joint 1, whose angle therefore drops out.
    turn = np.exp(1j * (theta2 + 2 * l1 * v1))
    forearm = turn * chord2
    z = chord1 + forearm
    zdot = (
        1j * rate1 * chord1
        + slope1 * w1
        + 1j * (rate1 + rate2 + 2 * l1 * w1) * forearm
        + turn * slope2 * w2
    )
    reach2 = np.abs(z) ** 2
    cosine = (reach2 - l1**2 - l2**2) / (2 * l1 * l2)
    if not (np.abs(cosine) < 1).all():
        raise ValueError(
            "`theta2` must stay away from multiples of pi, where the arm is stretched "
            "or folded and the rigid arm's rates do not exist. Got cos(theta2) up to "
            f"{np.abs(cosine).max():.6g} in magnitude; start further away or lower "
            "the velocity reference."
        )
    # The elbow bends to the side on which the forearm leaves the upper arm.
    side = np.sign((chord1.conj() * forearm).imag)
    product = z.conj() * zdot
    y2 = -product.real / (l1 * l2 * side * np.sqrt(1 - cosine**2))
    y1 = (product.imag - y2 * l2 * (l2 + l1 * cosine)) / reach2
    return np.stack([y1, y2], axis=-1)
