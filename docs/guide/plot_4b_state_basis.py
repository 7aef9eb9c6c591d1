r"""
.. _guide_state_basis:

Which state?
============

Local experiments are done at rest. Whatever depends on how *fast* the scheduling
variable moves, they cannot see. So two LPV models may have the same frozen models at
every :math:`\kappa` and still be different systems as soon as :math:`\kappa` moves:
with :math:`z = T(\kappa)\, x`,

.. math::

   \dot x = A x + B u
   \quad\Longleftrightarrow\quad
   \dot z = (T A T^{-1} + \dot T\, T^{-1})\, z + T B u .

To interpolate :math:`T A T^{-1}` is to leave :math:`\dot T\, T^{-1}` out. Which term is
left out, the state basis decides: that of the structure. No data of local experiments
can decide it; physics can, and so can one experiment in which :math:`\kappa` moves.
"""

# %%
# A skater pulls the arms in
# --------------------------
# A body that turns on a spring, with a moment of inertia :math:`J(\kappa)`. At rest its
# equation is :math:`J \ddot q + c \dot q + k q = u`. While J changes, the torques
# change the angular *momentum*:
# :math:`(J \dot q)^{\boldsymbol\cdot} = u - c \dot q - k q`. The same equations of
# motion, in the state :math:`(q, \dot q)` and in the state :math:`(q, J \dot q)`:

import numpy as np

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV

skater = {"M": [["J"]], "D": [[0.1]], "K": [[1]], "F": [[1]], "outputs": "velocity"}
structures = {
    "rate": GrayBoxStructure.mechanical(**skater),
    "momentum": GrayBoxStructure.mechanical(**skater, state="momentum"),
}
kappa = np.array([[0.0], [1.0]])
inertia = PolynomialLPV(degree=1).fit(kappa, 3.0 - 2.0 * kappa)
models = {
    name: LPVStateSpace(structure, inertia, kappa)
    for name, structure in structures.items()
}
difference = models["rate"].at(0.3) - models["momentum"].at(0.3)
print(f"Difference of the frozen models: {difference.hinf_norm():.0e}")

# %%
# The truth, integrated, and both models, while the arms go in and out. The model of
# rates follows the torque; but nothing in it turns faster when the arms come in.

from scipy.integrate import solve_ivp

STEP = 0.02
t = STEP * np.arange(1500)
pulled = 0.5 - 0.5 * np.cos(1.3 * t)
torque = np.where(t % 12 < 2, 1.0, 0.0)


def body(time, state):
    """Angle and angular momentum."""
    angle, momentum = state
    rate = momentum / (3.0 - 2.0 * (0.5 - 0.5 * np.cos(1.3 * time)))
    return [rate, (1.0 if time % 12 < 2 else 0.0) - 0.1 * rate - angle]


truth = solve_ivp(body, (0, t[-1]), [0, 0], t_eval=t, max_step=STEP, rtol=1e-8).y[1]
truth /= 3.0 - 2.0 * pulled

from lpvlearn.inspection import SimulationDisplay

display = SimulationDisplay.from_predictions(
    t,
    truth,
    {
        f"LPV, state of {name}": model.simulate(torque, pulled, STEP)
        for name, model in models.items()
    },
    units="rad/s",
    true_name="truth",
    output_names=["angular velocity"],
)

# %%
# The flexible arm
# ----------------
# The same choice, on identified models. The arm's structure in momenta has the same
# sixteen parameters as the one in rates: one set of local models serves both. Fit
# (percent) on the sweep, with the parabola and with the form that
# :class:`~lpvlearn.AutoLPV` chooses (:ref:`guide_interpolation`):

import pandas as pd

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    SubspaceLTI,
    bft_score,
)
from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
pipeline = LocalLPVPipeline(
    SubspaceLTI(horizon=60, feedthrough=False),
    GrayBoxRestructurer(data.structure),
    scheduling="kappa",
    experiment="experiment",
    time="time",
).fit(data.X, data.y)
rows = {}
for interpolator in (PolynomialLPV(degree=2), AutoLPV()):
    interpolator.fit(
        pipeline.operating_points_,
        pipeline.parameters_,
        covariance=pipeline.parameters_covariance_,
    )
    for state in ("rate", "momentum"):
        model = LPVStateSpace(
            data.arm.structure(state), interpolator, pipeline.lpv_.scheduling_range
        )
        y = model.simulate(
            data.X_sweep[["u1", "u2"]], data.X_sweep["kappa"], data.sampling_time
        )
        rows[type(interpolator).__name__, state] = bft_score(
            data.y_sweep, y, multioutput="raw_values"
        )
pd.DataFrame(rows, index=["y1", "y2"]).T.round(1)

# %%
# Neither does it alone: the right state needs the right interpolation. In the state of
# rates even the exact local models, at every angle, end where ``AutoLPV`` does.
#
# Which to take when
# ------------------
# Ask what a sudden change of :math:`\kappa`, without a force, leaves as it is. That
# belongs in the state.
#
# * **A mass matrix that follows the configuration** (robots, cranes, satellites): the
#   momenta. ``mechanical(..., state="momentum")``. What is still left out is half the
#   gradient of the kinetic energy, of second order in the rates.
# * **A mass that leaves or joins with the velocity of the body** (a tank truck that
#   drains, a burning fuel): the rates. ``state="rate"``.
# * **Stiffness or damping vary, the mass does not:** both are the same.
# * **Stores of a content** (tanks, capacitors, heat): the content. Write
#   ``from_template(E=..., A=..., B=..., C=..., descriptor="flux")``: read
#   :math:`(E x)^{\boldsymbol\cdot} = A x + B u`, with the level, voltage or temperature
#   x. With ``descriptor="rate"`` it is :math:`E \dot x = A x + B u`.
# * **A dependence that is slow** beside the dynamics: any of them.
# * **Not known:** compare both on an experiment in which :math:`\kappa` moves, as here.
#
# The other way round, :meth:`~lpvlearn.LPVStateSpace.change_basis` writes one LPV model
# in another state *with* the term :math:`\dot T\, T^{-1}`: its outputs stay what they
# are, and ``at(kappa, rate=...)`` has matrices that depend on the rate.

momentum = models["rate"].change_basis(lambda k: np.diag([1.0, 3.0 - 2.0 * k[0]]))
momentum.at(0.5).A, momentum.at(0.5, rate=1.0).A
