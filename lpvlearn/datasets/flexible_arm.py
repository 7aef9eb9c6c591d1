"""The two-link flexible arm: parameters, equations, linear models, response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.statespace import StateSpace
from ..structures.structure import GrayBoxStructure
from ..validation import number, one_of, positive_time, real_array, squarable
from .excitation import check_size, steps_of
from .mechanics import (
    arm_tables,
    check_coordinates,
    coordinate_change,
    inertial_terms,
    integrate,
    rigid_joint_rates,
)

Array = NDArray[np.float64]

# Step of the integration times fastest pole: for errors of 1e-9 of the response; and
# the largest, which leaves 1e-5.
_STEP, _LONGEST_STEP = 0.7, 2.0


@dataclass(frozen=True)
class FlexibleArm:
    """Planar two-link arm with bending links and joint velocity loops.

    One assumed bending mode a link, ``delta_k(x, t) = x^2 v_k(t)``, so that the
    coordinates are ``q = (theta1, theta2, v1, v2)`` and
    ``M(q) q'' = F(q, q') + G u`` (Eq. (26)), with the torques
    ``u = Lambda (reference - (theta1', theta2'))`` of the velocity loops (Eq. (29)).
    The input of the closed loop is the velocity reference of the two joints, the
    output y the joint rates of a rigid arm whose end-effector is at the same place,
    the scheduling variable ``kappa = cos(theta2)``.

    Parameters
    ----------
    l1, l2, rho1, rho2 : float
        Lengths of the links in m, masses per length in kg/m.
    EI1, EI2, J1, J2 : float
        Bending stiffnesses in N m2, hub inertias in kg m2.
    elbow_mass, tip_mass : float
        Point masses at the ends of link 1 and link 2 in kg.
    gains : sequence of two floats
        Diagonal of Lambda in N m s/rad.

    Raises
    ------
    ValueError
        If a parameter is not a finite positive number (masses and gains may be 0).

    Notes
    -----
    Stands for the arm of Section 3 of the paper. Its defaults are this library's
    own: the published text gives none. They are calibrated so that the analytic
    rows of the paper's tables come out.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.datasets import FlexibleArm
    >>> arm = FlexibleArm()
    >>> arm.linearize(np.pi / 2).order
    6
    >>> step = np.full((50, 2), 0.1)
    >>> response = arm.simulate(step, np.pi / 2, 1e-3)
    >>> response.y.shape, response.kappa.shape
    ((50, 2), (50,))
    """

    l1: float = 0.3
    l2: float = 0.3
    rho1: float = 0.77
    rho2: float = 0.77
    EI1: float = 89.0
    EI2: float = 12.0
    J1: float = 0.104
    J2: float = 0.109
    elbow_mass: float = 0.98
    tip_mass: float = 1.95
    gains: Sequence[float] = (0.774, 2.75)

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name != "gains":
                may_be_zero = field.name.endswith("mass")
                check_size(field.name, getattr(self, field.name), may_be_zero)
        gains = real_array("gains", self.gains)
        if gains.shape != (2,) or not np.all(np.isfinite(gains) & (gains >= 0)):
            raise ValueError(
                "`gains` must be two finite non-negative numbers, one a joint. "
                f"Got {self.gains}."
            )
        object.__setattr__(self, "gains", (float(gains[0]), float(gains[1])))

    @cached_property
    def _tables(self) -> Array:
        inertia = (self.J1, self.J2, self.elbow_mass, self.tip_mass)
        return arm_tables(self.l1, self.l2, self.rho1, self.rho2, *inertia)

    @cached_property
    def _stiffness(self) -> Array:
        """Elastic stiffness K over q."""
        return np.diag([0.0, 0.0, 4 * self.EI1 * self.l1, 4 * self.EI2 * self.l2])

    @cached_property
    def _damping(self) -> Array:
        """``G Lambda G'`` over q: the passive part of the velocity loops."""
        return np.diag([*self.gains, 0.0, 0.0])

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Mass matrix M(q) of Eq. (26).

        Parameters
        ----------
        q : array-like of shape (..., 4)
            ``(theta1, theta2, v1, v2)``.

        Returns
        -------
        M : ndarray of shape (..., 4, 4)
            Symmetric positive definite, in kg m2 (angles), kg m3 and kg m4 (bending).
        """
        q = check_coordinates("q", q)
        mass, _ = self._inertial_terms(q, np.zeros_like(q))
        T = coordinate_change(self.l1)
        M = T.T @ np.moveaxis(mass, -1, 0) @ T
        return (0.5 * (M + M.swapaxes(1, 2))).reshape(*q.shape, 4)

    def forces(self, q: ArrayLike, qdot: ArrayLike) -> Array:
        """Coriolis, centrifugal and elastic forces F(q, q') of Eq. (26).

        Parameters
        ----------
        q, qdot : array-like of shape (..., 4)
            Coordinates and their rates; leading axes are broadcast.

        Returns
        -------
        F : ndarray of shape (..., 4)
            Such that ``M q'' = F + G u`` with the joint torques u.

        Examples
        --------
        >>> FlexibleArm().forces([0.0, 1.0, 0.1, 0.0], [0.0, 0.0, 0.0, 0.0])
        array([  0.  ,   0.  , -10.68,   0.  ])
        """
        q, qdot = np.broadcast_arrays(
            check_coordinates("q", q), check_coordinates("qdot", qdot)
        )
        _, force = self._inertial_terms(q, qdot)
        F = force.reshape(4, -1).T @ coordinate_change(self.l1)
        return F.reshape(q.shape) - q @ self._stiffness

    def _inertial_terms(self, q: Array, qdot: Array) -> tuple[Array, Array]:
        T = coordinate_change(self.l1)
        r, rdot = (T @ x.reshape(-1, 4).T for x in (q, qdot))
        return inertial_terms(r.reshape(2, 2, -1), rdot.reshape(2, 2, -1), self._tables)

    def linearize(self, theta2: float) -> StateSpace:
        """Linear model at rest at the elbow angle `theta2`, Eq. (30)-(31).

        Parameters
        ----------
        theta2 : float
            Elbow angle in rad.

        Returns
        -------
        model : StateSpace
            Continuous, of order 6, from the velocity references to y, in the state
            ``(v1, v2, theta1', theta2', v1', v2')``.

        Examples
        --------
        >>> FlexibleArm().linearize(1.0).dc_gain().round(9) + 0.0
        array([[1., 0.],
               [0., 1.]])
        """
        M = self._rest_mass(theta2)
        loops = np.linalg.solve(M, self._damping[:, :2])
        A, B = np.zeros((6, 6)), np.zeros((6, 2))
        A[:2, 4:] = np.eye(2)
        A[2:, :2] = -np.linalg.solve(M, self._stiffness[:, 2:])
        A[2:, 2:4] = -loops
        B[2:] = loops
        return StateSpace(A, B, self._output_matrix())

    def rigid(self, theta2: float) -> StateSpace:
        """Linear model of the arm with rigid links (the rigid arm of Fig. 4).

        Parameters
        ----------
        theta2 : float
            Elbow angle in rad.

        Returns
        -------
        model : StateSpace
            Continuous, of order 2, in the state ``(theta1', theta2')``.
        """
        M = self._rest_mass(theta2)[:2, :2]
        loops = np.linalg.solve(M, self._damping[:2, :2])
        return StateSpace(-loops, loops, np.eye(2))

    def structure(self, form: str = "rate") -> GrayBoxStructure:
        """Gray-box structure of `linearize`, Eq. (32) corrected: p1, ..., p16.

        The parameters fill rows 3 to 6 of A column by column; B repeats columns 3
        and 4 with the opposite sign; C holds the lengths of the links and is known.

        Parameters
        ----------
        form : {"rate", "momentum"}, default="rate"
            The state: ``(v, q')``, as in the paper, or ``(v, z)`` with the momenta
            ``M q' = [G Lambda, K] z``. The parameters are the same, and so are the
            frozen models; but while theta2 moves, only momenta change by the forces
            alone: ``z' = [u - theta'; -v]``.

        Raises
        ------
        ValueError
            If `form` is unknown.

        Examples
        --------
        >>> arm = FlexibleArm()
        >>> momentum = arm.structure("momentum").model(arm.parameters(1.0))
        >>> bool((momentum - arm.linearize(1.0)).hinf_norm() < 1e-9)
        True
        """
        one_of("form", form, ("rate", "momentum"))
        p = np.array([f"p{i}" for i in range(1, 17)]).reshape(4, 4).T
        A: list[list[float | str]]
        B: list[list[float | str]]
        if form == "momentum":  # q' = Q z, the columns of Q are -p[:, [2, 3, 0, 1]]
            columns = p[:, [2, 3, 0, 1]]
            A = [[0, 0, *(f"-{name}" for name in row)] for row in columns[2:]]
            A += [[0, 0, *map(str, row)] for row in columns[:2]]
            A += [[-1, 0, 0, 0, 0, 0], [0, -1, 0, 0, 0, 0]]
            B = [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0], [0, 0]]
            C: list[list[float | str]] = [
                [0, 0, *(_weighed_sum(-row, column) for column in columns.T)]
                for row in self._output_matrix()[:, 2:]
            ]
            return GrayBoxStructure.from_template(A, B, C)
        A = [[0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]]
        A += [[*map(str, row), 0, 0] for row in p]
        B = [[0, 0], [0, 0]]
        B += [[f"-{name}" for name in row] for row in p[:, 2:]]
        return GrayBoxStructure.from_template(A, B, self._output_matrix().tolist())

    def parameters(self, theta2: float) -> Array:
        """True values of the parameters of `structure` at the elbow angle `theta2`.

        Parameters
        ----------
        theta2 : float
            Elbow angle in rad.

        Returns
        -------
        parameters : ndarray of shape (16,)

        Examples
        --------
        >>> arm = FlexibleArm()
        >>> model = arm.structure().model(arm.parameters(1.0))
        >>> bool((model.A == arm.linearize(1.0).A).all())
        True
        """
        return self.linearize(theta2).A[2:, :4].T.ravel()

    def _rest_mass(self, theta2: float) -> Array:
        theta2 = number("theta2", theta2, "one finite angle in rad")
        return self.mass_matrix([0.0, theta2, 0.0, 0.0])

    def _output_matrix(self) -> Array:
        C1 = [[1.0, 0.0, self.l1, 0.0], [0.0, 1.0, self.l1, self.l2]]
        return np.hstack([np.zeros((2, 2)), C1])

    def simulate(
        self,
        velocity_reference: ArrayLike,
        theta2: ArrayLike,
        sampling_time: float,
        *,
        integration_step: float | None = None,
    ) -> ArmResponse:
        """Integrate the non-linear equations in closed loop, from rest.

        By collocation at six Gauss points in every step; all experiments are integrated
        together.

        Parameters
        ----------
        velocity_reference : array-like, (n_samples, 2) or (n_experiments, n_samples, 2)
            Joint velocity references in rad/s, held over each sampling period.
        theta2 : float or array-like of shape (n_experiments,)
            Initial elbow angle in rad; theta1 starts at 0, the links unbent.
        sampling_time : float
            Sampling period of reference and response in s.
        integration_step : float or None, default=None
            Largest integration step in s: a fraction of the sampling period, or whole
            periods while no reference changes. None: 0.7 over the fastest pole, for
            errors of 1e-9 of the response.

        Returns
        -------
        response : ArmResponse
            With a leading axis of experiments unless a single reference is given
            with a single angle.

        Raises
        ------
        ValueError
            If shapes do not fit, the step is too long for the fastest pole, the motion
            is beyond arithmetic, or the arm comes to a singular position (stretched or
            folded), where y does not exist.
        """
        reference, angles = _pair_experiments(velocity_reference, theta2)
        sampling_time = positive_time("sampling_time", sampling_time)
        single = np.ndim(velocity_reference) == 2 and np.ndim(theta2) == 0
        n = len(angles)
        step = self._step(angles, sampling_time, integration_step)

        T = coordinate_change(self.l1)
        inverse = np.linalg.inv(T)
        q0 = np.zeros((4, n))
        q0[1] = angles
        with np.errstate(over="ignore", invalid="ignore"):  # told below
            states = integrate(
                np.concatenate([T @ q0, np.zeros((4, n))]),
                (inverse.T @ self._damping[:, :2]) @ np.moveaxis(reference, 0, -1),
                -inverse.T
                @ np.hstack([self._stiffness @ inverse, self._damping @ inverse]),
                self._tables,
                sampling_time,
                step,
            )
        if not np.isfinite(states).all():
            raise ValueError(
                "`velocity_reference` must be small enough for the motion to be "
                "followed: forces grow by the squares of the rates. Got up to "
                f"{np.abs(reference).max():.6g} rad/s; lower it."
            )
        states = np.moveaxis(states, -1, 0).reshape(n, -1, 2, 4)
        q, qdot = states[..., 0, :] @ inverse.T, states[..., 1, :] @ inverse.T
        y = self.rigid_rates(q, qdot)
        return ArmResponse(y[0], q[0], qdot[0]) if single else ArmResponse(y, q, qdot)

    def _step(
        self, angles: Array, sampling_time: float, integration_step: float | None
    ) -> float:
        fastest = max(
            np.abs(self.linearize(a).poles()).max() for a in np.unique(angles)
        )
        longest = _LONGEST_STEP / fastest
        if integration_step is None:
            integration_step = _STEP / fastest
        if sampling_time / steps_of(sampling_time, integration_step) > longest:
            raise ValueError(
                f"`integration_step` must be at most {longest:.3g} s for the "
                f"fastest pole ({fastest:.4g} rad/s). Got {integration_step}."
            )
        return min(float(integration_step), longest)

    def rigid_rates(self, q: ArrayLike, qdot: ArrayLike) -> Array:
        """Joint rates of the rigid arm whose end-effector moves like this one's.

        Exact inverse kinematics of Eq. (28); to first order in v and v' this is
        ``(theta1' + l1 v1', theta2' + l1 v1' + l2 v2')``, the matrix C of Eq. (31c).

        Parameters
        ----------
        q, qdot : array-like of shape (..., 4)
            Coordinates and their rates.

        Returns
        -------
        y : ndarray of shape (..., 2)
            In rad/s.

        Raises
        ------
        ValueError
            If the end-effector is out of the rigid arm's reach, or the arm is
            stretched or folded.

        Examples
        --------
        >>> FlexibleArm().rigid_rates([0.0, 1.0, 0.0, 0.0], [0.3, 0.2, 0.0, 0.0])
        array([0.3, 0.2])
        """
        return rigid_joint_rates(
            check_coordinates("q", q),
            check_coordinates("qdot", qdot),
            self.l1,
            self.l2,
        )


@dataclass(frozen=True, eq=False)
class ArmResponse:
    """Response of the arm at the sampling instants, before each input acts.

    The leading axis ``n_experiments`` is absent for a single experiment.

    Attributes
    ----------
    y : ndarray of shape (n_experiments, n_samples, 2)
        Joint rates of the rigid arm with the same end-effector position, rad/s.
    q, qdot : ndarray of shape (n_experiments, n_samples, 4)
        Coordinates ``(theta1, theta2, v1, v2)`` (rad, rad, 1/m, 1/m) and their rates.
    """

    y: Array
    q: Array
    qdot: Array

    @property
    def theta2(self) -> Array:
        """Elbow angle in rad, shape (n_experiments, n_samples)."""
        return self.q[..., 1]

    @property
    def kappa(self) -> Array:
        """Scheduling variable cos(theta2), shape (n_experiments, n_samples)."""
        return np.cos(self.theta2)


def _weighed_sum(weights: Array, names: NDArray[np.str_]) -> str:
    """An expression of a template: the names that weigh."""
    return " + ".join(
        f"{w:.17g}*{name}" for w, name in zip(weights, names, strict=True) if w
    )


def _pair_experiments(
    velocity_reference: ArrayLike, theta2: ArrayLike
) -> tuple[Array, Array]:
    """References (n_experiments, n_samples, 2) and initial angles (n_experiments,).

    One reference serves several angles and one angle several references.
    """
    name = "velocity_reference"
    reference = squarable(name, real_array(name, velocity_reference))
    if reference.ndim not in (2, 3) or reference.shape[-1] != 2:
        raise ValueError(
            "`velocity_reference` must have shape (n_samples, 2) or "
            f"(n_experiments, n_samples, 2). Got {reference.shape}."
        )
    if not np.isfinite(reference).all():
        raise ValueError("`velocity_reference` must be finite. Got NaN or infinity.")
    angles = real_array("theta2", theta2)
    if angles.ndim > 1 or angles.size == 0 or not np.isfinite(angles).all():
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
