"""Kinematics of the flexible arm: what its end-effector does, Eq. (28)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .dynamics import SHORTENING, FloatArray

ComplexArray = NDArray[np.complexfloating]


def check_coordinates(name: str, value: ArrayLike) -> FloatArray:
    """`value` as a finite array of shape (..., 4)."""
    array = np.asarray(value, dtype=float)
    if array.ndim == 0 or array.shape[-1] != 4:
        raise ValueError(
            f"`{name}` must have shape (..., 4): theta1, theta2, v1, v2. "
            f"Got {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite. Got NaN or infinity.")
    return array


def chord(length: float, v: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Vector from base to end of a bent link in its frame, and its v-derivative."""
    end = np.asarray(length + 1j * length**2 * v - SHORTENING * length**3 * v**2)
    slope = np.asarray(1j * length**2 - 2 * SHORTENING * length**3 * v)
    return end, slope


def rigid_joint_rates(
    q: FloatArray, qdot: FloatArray, l1: float, l2: float
) -> FloatArray:
    """Joint rates of the rigid arm with the same end-effector position and velocity.

    Parameters
    ----------
    q, qdot : ndarray of shape (..., 4)
        ``(theta1, theta2, v1, v2)`` and its time derivative.
    l1, l2 : float
        Lengths of the links in m.

    Returns
    -------
    y : ndarray of shape (..., 2)
        In rad/s.

    Raises
    ------
    ValueError
        If the end-effector is out of the rigid arm's reach, or the arm is stretched
        or folded.

    Examples
    --------
    >>> rigid_joint_rates(np.array([0.0, 1, 0, 0]), np.array([0.3, 0.2, 0, 0]), 1, 1)
    array([0.3, 0.2])
    """
    _, theta2, v1, v2 = np.moveaxis(q, -1, 0)
    rate1, rate2, w1, w2 = np.moveaxis(qdot, -1, 0)
    chord1, slope1 = chord(l1, v1)
    chord2, slope2 = chord(l2, v2)
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
