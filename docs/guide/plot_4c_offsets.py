r"""
.. _guide_points_of_work:

Systems that stand about offsets
================================

A disc with an eccentric mass on a motor: at every angle another voltage holds it there.
A tank: every level has its own flow. Local models are linear *about* such points of
work; the LPV model needs the points, too:

.. math::

   \dot x = A(\kappa)\,(x - x_0(\kappa)) + B(\kappa)\,(u - u_0(\kappa)), \qquad
   y = y_0(\kappa) + C(\kappa)\,(x - x_0(\kappa)) + D(\kappa)\,(u - u_0(\kappa)).

:class:`~lpvlearn.LocalLPVPipeline` finds them in the experiments as they were recorded,
levels and all.
"""

# %%
# The unbalanced disc
# -------------------
# Seven experiments, each about an angle at which a voltage holds the disc. The angle is
# output and scheduling variable at once. Two of the records:

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI, bft_score
from lpvlearn.datasets import make_unbalanced_disc

data = make_unbalanced_disc(random_state=0)
data.X.groupby("experiment")[["voltage", "kappa"]].agg(["mean", "min", "max"]).round(3)

# %%
# Nothing has to be subtracted. Where the constants of the experiments are significant
# (:ref:`guide_offsets`), the pipeline takes the equilibrium of each local model that is
# nearest to the means of its experiments. ``report_`` and ``summary()`` tell them:

roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
pipeline = LocalLPVPipeline(
    SubspaceLTI(2, feedthrough=False), GrayBoxRestructurer(data.structure), **roles
).fit(data.X, data.y)
found = pipeline.report_[["u0_voltage", "y0_angle"]]
found.assign(holds=data.holding_voltages).round(3)

# %%
# Between the points they are interpolated by a cubic spline: as they are, or what the
# models tell of them, or over the logarithm or the inverse of the scheduling variable,
# whichever foresees points that are left out clearly better. ``lpv_`` has them at any
# angle:

lpv = pipeline.lpv_
angles = np.array([-1.0, 0.2, 0.8])
pd.DataFrame(
    {
        "u0": lpv.input_offset(angles)[:, 0],
        "true u0": data.disc.holding_voltage(angles),
        "y0": lpv.output_offset(angles)[:, 0],
        "x0, angle": lpv.state_offset(angles)[:, 0],
        "x0, rate": lpv.state_offset(angles)[:, 1],
    },
    index=pd.Index(angles, name="angle"),
).round(4)

# %%
# A run through the whole range, beside what a model of the same local models is without
# offsets:

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # it says what it misses
    without = LocalLPVPipeline(
        SubspaceLTI(2, feedthrough=False),
        GrayBoxRestructurer(data.structure),
        offsets=None,
        **roles,
    ).fit(data.X, data.y)

from lpvlearn.inspection import SimulationDisplay

simulated = {
    "offsets": pipeline.predict(data.X_large),
    "none": without.predict(data.X_large),
}
display = SimulationDisplay.from_predictions(
    data.X_large["time"],
    data.y_large,
    simulated,
    units="rad",
    true_name="disc, without noise",
)
{name: round(bft_score(data.y_large, y), 1) for name, y in simulated.items()}

# %%
# Where predictions begin
# -----------------------
# ``predict`` has no outputs to look at: it begins at rest at the point of work of the
# first scheduling value. Step tests do not: they stand where their first inputs hold
# the system, and the point of work is near the means, of which most comes after the
# step. The experiments tell; ``lpv_.steady_start`` says which it is. With it every run
# whose inputs stand still at first (for five samples) and move later begins where these
# hold the model. A :class:`~lpvlearn.SubspaceLTI` does the same (``steady_start_``).

import matplotlib.pyplot as plt

time = np.arange(300) / 10.0
X_step = pd.DataFrame({"heating": np.where(time < 5.0, 30.0, 50.0)})
lag = 1.0 - np.exp(-np.maximum(time - 5.0, 0.0) / 3.0)
noise = 0.1 * np.random.default_rng(0).standard_normal(len(time))
y_step = pd.Series(25.0 + 0.4 * (30.0 + 20.0 * lag) + noise, name="temperature")
heater = SubspaceLTI(1, sampling_time=0.1).fit(X_step, y_step)

other = pd.DataFrame({"heating": np.where(time < 8.0, 45.0, 20.0)})
fig, ax = plt.subplots(figsize=(7, 2.6), layout="constrained")
ax.plot(time, y_step, color="0.6", label="measured")
ax.plot(time, heater.predict(X_step), label="predicted")
ax.plot(time, heater.predict(other), label="predicted, of another step")
ax.set_xlabel("Time (s)")
ax.set_ylabel("Temperature (°C)")
ax.legend()
print(heater.steady_start_)

# %%
# What the experiments do not tell
# --------------------------------
# An experiment at one point tells an equilibrium :math:`(u_0, y_0)`. Where the *state*
# rests there, it does not tell, and while :math:`\kappa` moves that matters: deviations
# about :math:`(u_0, y_0)` with :math:`x_0` left out are another system.

from dataclasses import replace

from lpvlearn import SplineLPV

points = pipeline.operating_points_
levels = np.hstack([found, np.zeros((len(points), 2))])  # u0, y0, and a state of zero
deviations = replace(lpv, offsets=SplineLPV("cubic").fit(points, levels))
y = deviations.simulate(
    data.X_large[["voltage"]], data.X_large["kappa"], data.sampling_time
)
round(bft_score(data.y_large, y), 1)

# %%
# So something is assumed:
#
# * **What holds the system comes through its inputs**, as gravity here acts where the
#   motor does. With the static gain :math:`G(0)` of the local model and
#   :math:`w = u_0 - G(0)^{-1} y_0`, the state at rest is that of the input
#   :math:`u_0 - w`: :math:`x_0 = -A^{-1} B\,G(0)^{-1} y_0`. That is the same as an
#   input offset, :math:`\dot x = A x + B (u - w)`, :math:`y = C x + D (u - w)`.
# * **Where points of work follow one another by the models' own gain**,
#   :math:`\mathrm d y_0 = G(0)\,\mathrm d u_0`, the system schedules itself, as this
#   one. Then :math:`A\,\mathrm d x_0 + B\,\mathrm d u_0 = 0` from point to point. In a
#   structure like this one both are the same; without a structure, states are
#   comparable between neighbours only, and this is what counts.
# * **Constants that are the same at all points** (of :math:`y - G(0)\,u`), where the
#   gain is not, are those of the sensors, and leave the state alone. So is the constant
#   of an output that does not answer at rest, :math:`G(0) = 0`: a rate, a
#   high-pass. Where both would do, the state that is nearer to zero is taken.
#   What the mean of the outputs makes of the state, with that constant, is one state at
#   all points where points that are left out do not tell otherwise: a set point that
#   inputs of hundreds of motions hold tells the noise of the parameters.
# * **More outputs than inputs:** the best :math:`u_0 - w` in the least-squares sense,
#   the rest are offsets of sensors. **More inputs than outputs:** the smallest
#   :math:`w`, for inputs of which the outputs tell nothing are what they are.
# * **Outputs that measure all states**, by the same :math:`C` at all points, tell them:
#   :math:`C x_0 = y_0 - D u_0`, though a source or a feed holds them that is no input.
#
# Between the points :math:`u_0`, :math:`y_0` and :math:`x_0` are splines. Where the
# system schedules itself, the gains tell their slopes too, and the splines have these,
# unless points that are left out speak against it. Where the
# equilibria bend more than the equations do (currents of a drive are rational in its
# speed, the back-EMF is linear), the constants of :math:`\dot x = A x + B u + c` are
# splines instead, if these tell points that are left out clearly better: of one
# scheduling variable, from five points on. So are inputs over their own logarithm, or
# over one over them (a valve that nearly saturates). Where the best of these misses
# outputs at rest, of points that are left out, by more than experiments move them,
# ``fit`` says so.
#
# A rate alone does not tell where a system stands: if the scheduling variable is a
# position, measure that as an output, too.
#
# If you know better, say it: ``LPVStateSpace(..., offsets=...)`` takes any fitted
# regressor from scheduling values to ``[u0, y0, x0]``, as above.
#
# In practice
# -----------
# * ``predict`` begins at rest at the point of work of the first sample, with
#   :math:`u_0` for the inputs before it, or where the first inputs hold the model (see
#   above); ``predict_with_initial_state`` estimates the state.
# * ``lpv_.at(kappa)`` is a model of deviations. ``lpv_.to_mat`` takes the points of
#   work along to MATLAB's ``ssInterpolant``.
# * ``offsets=None`` is a model whose outputs are zero at rest at input zero; where the
#   experiments speak against that, ``fit`` says so.
# * Where the scheduling variable moves slowly *within* local experiments (a battery is
#   discharged by the current that excites it), what outputs at rest do with it,
#   :math:`y_0(\kappa(t)) - y_0(\bar\kappa)`, is no mode of the plant: it is taken
#   out of them where inputs stand at one level everywhere and the local models are
#   likelier so, and told (of up to a million samples).
# * Constants that *differ* between experiments at one point are averaged, with a
#   warning: the model cannot know which one comes next. If they belong to levels of
#   another quantity, make that a scheduling variable.
# * ``SubspaceLTI(detrend="constant")`` takes the means of the experiments for points
#   of work.
