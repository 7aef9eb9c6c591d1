r"""
.. _how_to_control:

Close the loop
==============

A gain-scheduled controller for an arm of two flexible links: a linear-quadratic
regulator and an observer at every angle of the elbow, from the *identified* model,
tried on the non-linear equations. Nothing of the true arm goes into the design.
"""

# %%
# The model
# ---------
# Seven local experiments of 3 s, one at every angle of the elbow; its cosine schedules.
# The arm is wanted while it moves, so its state are momenta (:ref:`guide_state_basis`).

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI
from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
arm = data.arm
pipeline = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False),
    GrayBoxRestructurer(arm.structure("momentum")),
    scheduling="kappa",
    experiment="experiment",
    time="time",
).fit(data.X, data.y)
lpv = pipeline.lpv_

# %%
# A controller at every angle
# ---------------------------
# Inputs are velocity references of the two joints, outputs the rates :math:`y` of the
# arm's end. At each of 31 angles, with the frozen model in discrete time:
#
# * the regulator :math:`K` minimises :math:`\sum |y - r|^2 + \varrho |u - r|^2`;
# * the observer :math:`L` is the Kalman filter for disturbances at the joints;
# * :math:`N r` is the state of rest at the reference :math:`r`,
#   :math:`N = (I - A)^{-1} B`.
#
# .. math::
#    u = r - K (\hat x - N r), \qquad
#    \hat x^+ = A \hat x + B u + L (y - C \hat x)

from scipy.linalg import solve_discrete_are

STEP, RHO = 0.002, 0.01


def controller(kappa):
    """A, B, C of the frozen model, and K, L, N."""
    model = lpv.at(kappa).to_discrete(STEP)
    A, B, C = model.A, model.B, model.C
    P = solve_discrete_are(A, B, C.T @ C + 1e-9 * np.eye(6), RHO * np.eye(2))
    K = np.linalg.solve(RHO * np.eye(2) + B.T @ P @ B, B.T @ P @ A)
    S = solve_discrete_are(A.T, C.T, B @ B.T + 1e-9 * np.eye(6), 1e-4 * np.eye(2))
    L = A @ S @ C.T @ np.linalg.inv(C @ S @ C.T + 1e-4 * np.eye(2))
    return A, B, C, K, L, np.linalg.solve(np.eye(6) - A, B)


grid = np.linspace(*lpv.scheduling_range[:, 0], 31)
tables = [np.array(entry) for entry in zip(*map(controller, grid), strict=True)]

# %%
# Is one controller enough? The loop of the plant at an angle with the controller for
# another one has twelve poles; their largest modulus, over the range of the plant:


def largest_pole(plant, fixed):
    """Of the loop of the plant and the controller for two angles of the grid."""
    A, B, C, *_ = (table[plant] for table in tables)
    model, enters, leaves, K, L, _ = (table[fixed] for table in tables)
    loop = np.block([[A, -B @ K], [L @ C, model - enters @ K - L @ leaves]])
    return np.abs(np.linalg.eigvals(loop)).max()


worst = {
    "scheduled": max(largest_pole(k, k) for k in range(31)),
    "for the first angle": max(largest_pole(k, 30) for k in range(31)),
    "for the middle angle": max(largest_pole(k, 15) for k in range(31)),
    "for the last angle": max(largest_pole(k, 0) for k in range(31)),
}
pd.Series(worst, name="largest modulus of a pole").round(3)

# %%
# Above 1 the loop is unstable at some angle. Below it everywhere is necessary and not
# sufficient: what happens on the way from one angle to the next, a simulation tells.
#
# With `python-control <https://python-control.readthedocs.io>`_ the regulator is one
# line; frozen models go there by ``to_control``, and a model that is made there comes
# back by ``StateSpace.from_control``:
#
# .. code-block:: python
#
#    import control
#
#    frozen = lpv.at(0.5).to_discrete(STEP).to_control()
#    K, P, poles = control.dlqr(frozen, frozen.C.T @ frozen.C, RHO * np.eye(2))
#
# The test
# --------
# The non-linear equations of motion, :math:`M(q) \ddot q = f(q, \dot q) + G \tau`, by
# Runge-Kutta steps of 0.5 ms. The elbow turns from 22 degrees to 125, and the shoulder
# helps. Three loops run side by side: without a controller, with the one that is
# scheduled by the measured angle, and with the one for the middle angle.

SAMPLES, SUBSTEPS = 800, 4
time = STEP * np.arange(SAMPLES)
reference = np.zeros((SAMPLES, 2))
reference[:, 0] = np.where((time > 0.4) & (time < 0.8), 0.6, 0.0)
reference[:, 1] = np.where((time > 0.1) & (time < 1.3), 1.5, 0.0)


def at(kappa):
    """The controllers at some angles, by straight lines between those of the grid."""
    place = np.interp(kappa, grid, np.arange(len(grid)))
    low = np.minimum(place.astype(int), len(grid) - 2)
    share = (place - low)[:, None, None]
    return [(1 - share) * table[low] + share * table[low + 1] for table in tables]


def acceleration(q, rate, u):
    torque = np.zeros_like(q)
    torque[:, :2] = arm.gains * (u - rate[:, :2])
    force = arm.forces(q, rate) + torque
    return np.linalg.solve(arm.mass_matrix(q), force[..., None])[..., 0]


def move(q, rate, u, h):
    """A Runge-Kutta step."""
    a1 = acceleration(q, rate, u)
    a2 = acceleration(q + h / 2 * rate, rate + h / 2 * a1, u)
    a3 = acceleration(q + h / 2 * (rate + h / 2 * a1), rate + h / 2 * a2, u)
    a4 = acceleration(q + h * (rate + h / 2 * a2), rate + h * a3, u)
    step = h * rate + h**2 / 6 * (a1 + a2 + a3)
    return q + step, rate + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


LOOPS = ["no controller", "scheduled", "for the middle angle"]
rng = np.random.default_rng(0)
q, rate, x = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 6, 1))
q[:, 1] = np.pi / 8
outputs, commands = np.empty((2, SAMPLES, 3, 2))
for k, r in enumerate(reference):
    y = arm.rigid_rates(q, rate) + 1e-3 * rng.standard_normal((3, 2))
    kappa = np.cos(q[:, 1])
    kappa[2] = grid[15]
    A, B, C, K, L, N = at(kappa)
    u = r - (K @ (x - N @ r[:, None]))[..., 0]
    u[0] = r
    x = A @ x + B @ u[..., None] + L @ (y[..., None] - C @ x)
    outputs[k], commands[k] = y, u
    for _ in range(SUBSTEPS):
        q, rate = move(q, rate, u, STEP / SUBSTEPS)

# %%
# Root mean squares of what is missing to the reference, over the whole record and after
# the elbow should have stopped, and the largest command:

error = outputs - reference[:, None]
after = time > 1.32
result = pd.DataFrame(
    {
        "error, y1": np.sqrt((error[..., 0] ** 2).mean(axis=0)),
        "error, y2": np.sqrt((error[..., 1] ** 2).mean(axis=0)),
        "after, y1": np.sqrt((error[after, :, 0] ** 2).mean(axis=0)),
        "after, y2": np.sqrt((error[after, :, 1] ** 2).mean(axis=0)),
        "largest command": np.abs(commands).max(axis=(0, 2)),
    },
    index=LOOPS,
)
result.round(2)

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(2, sharex=True, figsize=(8, 4.6), layout="constrained")
styles = [("0.6", 1.0), ("#D55E00", 1.4), ("#0072B2", 1.0)]
for j, ax in enumerate(axes):
    ax.plot(time, reference[:, j], "k--", lw=1, label="reference")
    for loop, name in enumerate(LOOPS):
        colour, width = styles[loop]
        ax.plot(time, outputs[:, loop, j], color=colour, lw=width, label=name)
    ax.set_ylabel(f"y{j + 1} (rad/s)")
axes[0].legend(ncols=4, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
_ = axes[1].set_xlabel("Time (s)")

# %%
# **Before it goes to hardware.** Commands of the size above need amplifiers that give
# them: raise ``RHO`` until they do. Draw the responses with their bands
# (``BodeDisplay.from_estimator(pipeline, kappa=..., uncertainty=True)``) and lay a
# controller out for the models that the data leave possible. ``lpv.lfr()`` and
# ``lpv.coefficients()`` are what LPV synthesis takes: :ref:`guide_taking_out`.
