r"""
.. _guide_local:

Local models
============

Step 3. At each operating point :math:`\kappa_i` a black-box model

.. math::

   x_{k+1} = \mathfrak{A} x_k + \mathfrak{B} u_k, \qquad
   y_k = \mathfrak{C} x_k + \mathfrak{D} u_k

is identified by a subspace method: no starting values, no iterations that may fail, and
any number of inputs and outputs.
"""

# %%
# How it works
# ------------
# Stack :math:`h` consecutive outputs. With the *observability matrix*
# :math:`\mathcal{O} = [\mathfrak{C};\, \mathfrak{C}\mathfrak{A};\, \dots;\,
# \mathfrak{C}\mathfrak{A}^{h-1}]` they are
#
# .. math::
#
#    \begin{bmatrix} y_k \\ \vdots \\ y_{k+h-1} \end{bmatrix}
#    = \mathcal{O}\, x_k + \mathcal{T}
#    \begin{bmatrix} u_k \\ \vdots \\ u_{k+h-1} \end{bmatrix} + \text{noise}.
#
# Project the future inputs away, and correlate with past data, in which the present
# noise is not contained: what remains has the range of :math:`\mathcal{O}`. A singular
# value decomposition gives it; :math:`\mathfrak{C}` is its first block and
# :math:`\mathfrak{A}` maps it on itself, shifted by one block. With these two the
# simulated output is linear in :math:`\mathfrak{B}, \mathfrak{D}` and :math:`x_0`,
# which follow by least squares; a few Gauss-Newton steps polish everything
# (``refine="auto"``). What they minimise is the simulation error, filtered until it is
# white and weighted until all outputs have the same: the most accurate thing to do
# under coloured or unequal noise, and the simulation error itself where the noise is
# white. The plain error (``refine="simulation"``) is taken where it predicts parts of
# the record better that were held out, as it may where the system is not linear.
#
# ``method`` says what serves as past data: inputs and outputs (``"po-moesp"``, what the
# default is in open loop; ``"n4sid"`` and ``"cva"`` weight them differently), or inputs
# alone (``"pi-moesp"``, the paper's choice, which coloured measurement noise does not
# disturb). For ``"pbsid"`` see :ref:`guide_closed_loop`. In open loop the default takes
# that one where noise moves the plant itself, as wind moves a tower, and not its
# sensors: such noise tells of the poles what inputs do not, which is worth most of
# modes that these hardly excite. Taken is what is likelier.

import numpy as np

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
here = data.X["experiment"] == 0
X, y = data.X[here], data.y[here]
roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}

local = SubspaceLTI(feedthrough=False, **roles).fit(X, y)
local.lti_

# %%
# Order and horizon
# -----------------
# Every order is fitted to the record, with its errors whitened, and a criterion like
# Akaike's weighs what a state gains against the parameters that it takes. The choice, a
# few lower orders, and higher ones that the criterion hardly tells from it, then
# simulate parts of the record that were held out; one that does so clearly better is
# taken instead. For each order the best horizon, the error before the polishing steps,
# the criterion above the best one, and how well the parts held out are predicted, where
# that was looked at:

table = local.selection_.dropna(subset="criterion").set_index("order")
table.round({"error": 4, "criterion": 4, "validation_bft": 2})

# %%
# Up to order 5 a mode is missing, from 6 on nothing is gained. ``selection_`` holds all
# candidates. The horizon
# matters too (relative error in percent, before the polishing steps):

table = local.selection_.query("order == 6").set_index("horizon")
100 * table[["error"]].round(4)

# %%
# The singular values tell the same story. A gap marks the order that the data support:

from lpvlearn.inspection import BodeDisplay, SingularValueDisplay

display = SingularValueDisplay.from_estimator(local)

# %%
# To continuous time
# ------------------
# Physics is written in continuous time, so that the model is converted:
# ``to_continuous("zoh")`` by the matrix logarithm, exact for inputs that are held
# between samples, which is how a computer drives a system; ``to_continuous("tustin")``
# by the bilinear approximation of the paper, which warps the frequencies.

continuous = local.lti_.to_continuous("zoh")
continuous.poles().round(2)

# %%
# Here the truth is known, as the arm is simulated:

truth = data.arm.linearize(data.theta2[0])
display = BodeDisplay.from_models({"truth": truth, "identified": continuous})

# %%
# .. _guide_balanced:
#
# Balanced, and why that is not enough
# ------------------------------------
# ``balance()`` brings a model into coordinates in which each state is as controllable
# as it is observable. They are unique up to signs, so that models of several noise
# realizations at *one* point can be averaged (``combine="average"``). But from one
# operating point to the next the order of the states may change, and with it the
# meaning of each:

import pandas as pd

from lpvlearn import LocalLPVPipeline

baseline = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False), "passthrough", **roles
).fit(data.X, data.y)
entry = [model.A[0, 1] for model in baseline.structured_models_]
pd.Series(entry, index=baseline.operating_points_[:, 0].round(2), name="A[1, 2]").round(
    1
)

# %%
# The entry jumps between two neighbouring points. No polynomial passes through that,
# and none should: the two numbers describe different things. The :ref:`next page
# <guide_restructuring>` removes the ambiguity.
#
# What a model knows about itself
# -------------------------------
# Standard deviations of the poles, from the curvature of the simulation error and the
# noise that it left:

std = local.poles_std_
pd.DataFrame(
    {
        "pole": local.lti_.poles().round(4),
        "std of the real part": std.real,
        "std of the imaginary part": std.imag,
    }
)

# %%
# Delays
# ------
# Valves, transport and field buses act late. A delay of five samples would cost five
# states, or bend the parameters that a structure without delay finds.
# ``input_delay=5``, or ``[5, 0]`` for two inputs, takes it out:
# the model is identified from inputs as they arrive, and ``lti_`` carries the delay
# beside its matrices, in simulations and responses. ``input_delay="auto"`` looks for
# it: a delay is taken where it is certain, else none.


late = StateSpace([[1.6, -0.8], [1, 0]], [[1], [0]], [[0.2, 0.1]], None, 0.01, 5)
rng = np.random.default_rng(0)
u = rng.standard_normal((600, 1))
noisy = late.simulate(u) + 0.05 * rng.standard_normal((600, 1))
for delay in (0, "auto"):
    model = SubspaceLTI(input_delay=delay, sampling_time=0.01).fit(u, noisy)
    print(delay, model.lti_)

# %%
# Delays count from :math:`\mathfrak{D}`: a sampled system without feedthrough, which
# answers one sample after its input, has a delay of 0.
#
# What arrives in the first samples of an experiment was sent before it began. The fit
# leaves these samples out, or takes the input before as zero with
# ``initial_state="rest"``, as ``predict`` does. ``predict_with_initial_state``
# estimates what was in transit along with the state. ``partial_fit`` needs a delay that
# is given.
#
# In a pipeline, ``LocalLPVPipeline(SubspaceLTI(input_delay="auto"), ...)``: the
# structure is compared with what is left of the local model and has no delay itself;
# the structured model and ``lpv_`` carry it. ``report_`` has it in columns
# ``"delay_"`` by input. The points tell one delay together where that is as likely as
# one of each; not with ``integrating``, nor where models of experiments are averaged,
# where each finds its own. Where they differ beyond doubt, a warning lists them, and
# ``lpv_`` takes the median. A local estimator that is left at its default has a delay
# looked for, too, where models tell of one, and taken with a warning where all points
# have the same; ``input_delay=[0]`` asks for none.
#
# .. _guide_offsets:
#
# Offsets and drifts
# ------------------
# Measured signals stand about a point of work: a temperature of 80 degrees under a
# valve that is half open. About the point :math:`(u_0, y_0)` the model is
#
# .. math::
#
#    y - y_0 = G\,(u - u_0) \quad\Longleftrightarrow\quad y = G\,u + c,
#    \qquad c = y_0 - G(1)\,u_0,
#
# but for a transient that the initial state takes. So one unknown number for each
# output stands for all offsets, and it belongs to the experiment, as the initial state
# does. ``offset="constant"`` estimates it together with :math:`\mathfrak{B},
# \mathfrak{D}` and :math:`x_0`, in every step of the refinement too, and projects a row
# of ones out of the subspace step. The default, ``"auto"``, does so where the constants
# are significant, given the colour of the noise, and where signals stay three standard
# deviations or more from zero unless that refutes them: the samples then hardly tell
# whether rest at zero is rest, and predictions are to begin where the signals are. It
# is the model without constants elsewhere. Two experiments with different offsets:

two = X.iloc[:2000].copy()
two["experiment"] = np.repeat(["morning", "evening"], 1000)
moved = y.iloc[:2000] + np.where(two[["experiment"]] == "morning", 0.3, -0.2)

settings = {"horizon": 40, "feedthrough": False, **roles}
offset = SubspaceLTI(6, **settings).fit(two, moved)
print("offset_:", offset.offset_)
pd.DataFrame(offset.output_offset_, ["morning", "evening"], moved.columns).round(3)

# %%
# ``output_offset_`` is where the outputs rest at the mean inputs, ``input_offset_``; of
# a plant that hardly settles within a record, both are where the experiments begin
# nearest to rest. ``predict`` begins there; or, where that is far from all outputs, as
# a mode that does not decay holds a part of their level, in the state that the
# experiments begin in (``begun_state_``). Inputs alone do not tell which offset they
# have, so where those of the experiments differ, ``predict`` takes their mean and
# warns; with outputs at hand, ``predict_with_initial_state``, scores with
# ``initial_state="estimate"`` and ``residual_tests`` estimate each experiment's own.
# The first two do so too where ``"auto"`` found none in the samples of the fit, and a
# level explains most of the errors in others, beyond chance.
#
# * ``offset="linear"`` adds a drift (``output_drift_``, per second). It is also what a
#   system that *integrates* needs, a motor whose amplifier has a bias: its answer to an
#   offset of the input is a straight line, and is told as ``input_offset_``, which
#   ``predict`` knows. ``"auto"`` takes either where a mode that does not decay, and no
#   input moves, would stand for it: on other records such a mode goes astray. Of a
#   drift that is there beyond doubt it asks no more. Without a structure a pipeline
#   asks all its operating points together. With ``integrating`` it is a constant rate.
# * A load that comes or goes, or a sensor that moves, shifts the level within an
#   experiment. A slow mode would explain it, and simulate other records by what it made
#   up. ``"auto"`` looks for such shifts, which no regression on the past foresees, ends
#   the experiment there and begins another, with a warning that says where.
# * Where outputs wander (a temperature, a bias, loads that add up), a slow mode follows
#   what no input did, whatever constants there are. The differences of the samples have
#   the same plant, and a noise that does not wander: the model is theirs where that is
#   likelier, or where the samples need a mode slower than the record to do better,
#   unless they need no more states than their differences for a noise that stays. Its
#   static gain is less certain, as its deviations say, and constants no larger than the
#   drift are none.
# * Hum of the mains or the runout of a shaft, a sinusoid that no input moves, is
#   subtracted, with a warning that says at which frequency. Two states would stand for
#   it at the border of stability, or be missing where the order is given. It must stay
#   what it is for two periods of a record or more; with ``refine="simulation"`` or
#   False, ``stability="enforce"`` and starts at rest it is not looked for.
# * An output that stays at its largest or smallest value while the inputs move is at a
#   limit, of its sensor or of the plant. A fit tells of it; NaN for these samples and
#   ``missing="estimate"`` leave them out.
# * ``offset=None`` says that outputs are zero at rest at input zero, and that every
#   constant tells something of the static gain.
# * ``detrend="constant"`` or ``"linear"`` subtracts means or straight lines from inputs
#   and outputs before anything else. A mean is not where the system rests: what the
#   transients at both ends add to it remains as an error, which ``offset`` does not
#   have (with ``detrend`` set, "auto" means None; ``offset="constant"`` may follow it).
# * A :class:`~lpvlearn.LocalLPVPipeline` makes them points of work that follow the
#   scheduling variable: :ref:`guide_points_of_work`.

# %%
# .. _guide_closed_loop:
#
# Data from a closed loop
# -----------------------
# Often a controller cannot be switched off. Its inputs then know the noise of the
# outputs, and whatever minimises the simulation error has a bias that no number of
# samples removes. Every fit looks for that: do future inputs tell of the errors that a
# long regression leaves? A plant under proportional feedback, with process noise:

import warnings

rng = np.random.default_rng(0)
A, B, C = np.array([[1.5, -0.7], [1.0, 0.0]]), np.array([1.0, 0.0]), [0.5, 0.3]
K = np.array([0.4, 0.2])
plant = StateSpace(A, B[:, None], [C], sampling_time=1.0)
reference, noise = rng.standard_normal((2, 4000))
force, position, x = np.zeros((4000, 1)), np.zeros(4000), np.zeros(2)
for k in range(4000):
    position[k] = C @ x + 0.5 * noise[k]
    force[k] = reference[k] - 0.4 * position[k]
    x = A @ x + B * force[k] + K * noise[k]

with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    in_loop = SubspaceLTI(2).fit(force, position)
print(told[0].message)

# %%
# ``method="auto"`` has taken ``"pbsid"``, predictor-based subspace identification,
# which minimises the error of prediction. What the others make of these data:

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    biased = SubspaceLTI(2, method="po-moesp", feedthrough=False).fit(force, position)
display = BodeDisplay.from_models(
    {"truth": plant, "pbsid": in_loop.lti_, "po-moesp": biased.lti_}
)

# %%
# What to do with data from a closed loop:
#
# * Best, let a reference or a signal added to the controller's output excite the
#   loop, and record it. With it as input the data are those of an open loop: the model
#   is that of the loop, and the controller, which is known, belongs into the structure.
#   A plant that is stable only in its loop can be brought into a structure in this
#   way alone.
# * Else leave ``method="auto"``, or say ``method="pbsid"``. Plant and noise share their
#   states there; modes that only the noise drives are told from those of the plant.
#   Standard deviations and ``predict_ahead`` are right under feedback, and the plant
#   may be unstable: the model is then good for prediction, not for long simulations.
#   Constants and drifts of the experiments (``offset``) are estimated there as well.
#   A plant that grows by itself though its outputs have not is taken for one in a loop,
#   be its noise too small to be known to the inputs.
# * Say ``feedthrough=False`` unless the controller needs a sample to answer: a
#   feedthrough and a controller that answers within the sample can be told apart where
#   the reference moves by steps, as "auto" does, but not where signals are Gaussian.
#   Parts held out, which "auto" asks then, tell little where disturbances move the loop
#   more than the reference does.
# * A loop that only disturbances move, about a set-point that stays, tells the
#   controller and not the plant: every input follows from the outputs, exactly, and the
#   model is the controller, inverted. A warning says so where the controller is a P, PI
#   or PID one, or answers a sample later. Let the set-point move by random steps, or
#   add noise to the input.
# * That of feedback may be false where channels are not sampled at once: outputs that
#   are means over the sample to come know the next inputs, too. "auto" then leaves D
#   free, or takes ``"po-moesp"``, where parts held out speak clearly for it, and says
#   both figures. Give the outputs a sample later if that is what happened.
# * Outputs that lead the inputs by several samples, as clocks that differ or filters of
#   the inputs alone make them, know what is to come as well. If later inputs explain
#   parts held out ten times better (squared errors), a warning says how much later.

in_loop.predictor_.K.round(2)

# %%
# Does it lack something?
# -----------------------
# A fit of whose errors past inputs explain more than 3 %, beyond chance, warns: states,
# a delay or a nonlinearity is missing. ``residual_tests`` says more:

local.residual_tests(X, y)

# %%
# Is the system linear there, and the same all along?
# ---------------------------------------------------
# A linear model of a plant that bends (friction, a valve, a sensor that saturates) is
# an average over the motions of its record, and simulates others worse, however small
# its standard deviations are. In open loop a fit warns where squares and cubes of the
# inputs, or of what they do, explain errors of more than 3 % of an output, or what
# these lose in play, as in gears and by friction, or large changes of the inputs, as
# behind an actuator whose rate is limited: the errors of a linear plant do not know
# these. Here the input acts by its hyperbolic tangent:

bending = np.random.default_rng(0).uniform(-2.0, 2.0, (100, 1)).repeat(5, axis=0)
answer = np.zeros(len(bending))
for t in range(1, len(bending)):
    answer[t] = 0.9 * answer[t - 1] + np.tanh(1.5 * bending[t - 1, 0])
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    SubspaceLTI(sampling_time=1.0).fit(bending, answer)
print(told[0].message)

# %%
# A plant that changes along its record (it warms up, a load is put on, a sensor drifts)
# is told where models of parts of it leave less than half of the error of the one for
# all, and that is more than a tenth of an output.
#
# Long records and gaps
# ---------------------
# * ``partial_fit`` takes a record batch by batch, in memory that does not grow with it.
#   The model is the one that ``fit`` finds from the whole record, however it is cut;
#   with a ``time`` column a batch that repeats or leaves out samples is refused (with
#   ``missing="split"``, one that repeats them).
# * ``initial_state="rest"`` says that experiments start at rest, instead of estimating
#   where each starts: worth it for many short ones.
# * ``missing="split"`` ends an experiment before a sample with NaN, or a row that the
#   ``time`` column misses, and starts another one after it, with an initial state and a
#   constant of its own; ``"estimate"`` estimates outputs that are missing, and ends an
#   experiment where inputs are: :ref:`guide_logs`.
# * ``integrating="angle"`` identifies the rate of an output that integrates, and
#   integrates the model: see the example of a position servo. What inputs do to it at
#   once (a current to the voltage of a battery) is kept as D. A pipeline without a
#   structure interpolates the model of the rates, and integrates that, also where it
#   finds itself, and says, that an output integrates at all points.
# * ``stability="enforce"`` returns a stable model and says in ``stability_loss_`` what
#   that cost.

streamed = SubspaceLTI(6, **settings)
for batch in range(3):
    rows = slice(1000 * batch, 1000 * (batch + 1))
    streamed.partial_fit(X.iloc[rows], y.iloc[rows])
whole = SubspaceLTI(6, **settings).fit(X[:3000], y[:3000])
abs(streamed.lti_.poles() - whole.lti_.poles()).max()
