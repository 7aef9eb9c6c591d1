"""What goes into a simulation of the arm and what comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .dynamics import FloatArray

__all__ = ["ArmResponse"]


@dataclass(frozen=True)
class ArmResponse:
    """Response of the arm at the sampling instants, before each input acts.

    The leading axis ``n_experiments`` is absent for a single experiment.

    Attributes
    ----------
    y : ndarray of shape (n_experiments, n_samples, 2)
        Joint rates of the rigid arm with the same end-effector position, rad/s.
    q, qdot : ndarray of shape (n_experiments, n_samples, 4)
        Coordinates ``(theta1, theta2, v1, v2)`` (rad, rad, 1/m, 1/m) and their rates.

    Examples
    --------
    >>> from lpvlearn.datasets import FlexibleArm
    >>> response = FlexibleArm().simulate(np.zeros((5, 2)), np.pi / 3, 1e-3)
    >>> response.kappa.round(6)
    array([0.5, 0.5, 0.5, 0.5, 0.5])
    """

    y: FloatArray
    q: FloatArray
    qdot: FloatArray

    @property
    def theta2(self) -> FloatArray:
        """Elbow angle in rad, shape (n_experiments, n_samples)."""
        return self.q[..., 1]

    @property
    def kappa(self) -> FloatArray:
        """Scheduling variable cos(theta2), shape (n_experiments, n_samples)."""
        return np.cos(self.theta2)


def pair_experiments(
    velocity_reference: ArrayLike, theta2: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """References (n_experiments, n_samples, 2) and initial angles (n_experiments,).

    One reference serves several angles and one angle several references.
    """
    reference = np.asarray(velocity_reference, dtype=float)
    if reference.ndim not in (2, 3) or reference.shape[-1] != 2:
        raise ValueError(
            "`velocity_reference` must have shape (n_samples, 2) or "
            f"(n_experiments, n_samples, 2). Got {reference.shape}."
        )
    if not np.isfinite(reference).all():
        raise ValueError("`velocity_reference` must be finite. Got NaN or infinity.")
    angles = np.asarray(theta2, dtype=float)
    if angles.ndim > 1 or not np.isfinite(angles).all():
        raise ValueError(
            "`theta2` must be one finite angle in rad or one for each experiment. "
            f"Got {angles}."
        )
    if reference.ndim == 3 and angles.ndim and len(angles) != len(reference):
        raise ValueError(
            "`theta2` must hold one angle for each experiment of "
            f"`velocity_reference` ({len(reference)}). Got {len(angles)}."
        )
    n = len(reference) if reference.ndim == 3 else angles.size
    return (
        np.broadcast_to(reference, (n, *reference.shape[-2:])),
        np.broadcast_to(angles, (n,)),
    )
