r"""
.. _how_to_plants:

Write a structure for your plant
================================

A structure is the state equations with names where the numbers are unknown. Ten plants,
and with each a point that comes up with others, too. Take the nearest one and change
it. Three rules:

1. **Write what you know as numbers**, also zeros and ones. Every name is a number that
   the data must tell.
2. **Names where physics has them.** Equations of motion go into
   :meth:`~lpvlearn.GrayBoxStructure.mechanical`, those with capacities or inductances
   in front of the derivatives into ``from_template(A, B, C, E=...)``; what else is not
   a sum goes into :meth:`~lpvlearn.GrayBoxStructure.from_function`.
3. **Test it before the experiment**, as below: do parameters come back from the
   model's own response? If not, the measurement you plan cannot tell them.

``recover`` does that test. First it turns the states of the model until nothing of the
structure is left, and asks for the parameters back, with no first guess. Then it does
an experiment of 3000 samples with 40 dB of noise on it, and identifies.
"""

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, LocalLPVPipeline
from lpvlearn.datasets import prbs

largest_errors = {}


def recover(plant, structure, truth, *, step, clock=4):
    """The parameters from the response, and from noisy data with their deviations."""
    names = list(structure.parameter_names)
    model = structure.model(truth)
    true = pd.Series(truth)[names] if isinstance(truth, dict) else truth
    table = pd.DataFrame({"true": true}, index=names)
    exact = GrayBoxRestructurer(structure).fit_model(model.balance())
    table["from the response"] = exact.params_

    u = prbs(3000, model.n_inputs, clock=clock, random_state=0)
    y = model.simulate(u, sampling_time=step)
    noise = np.random.default_rng(1).standard_normal(y.shape)
    X = pd.DataFrame(u).add_prefix("u").assign(time=step * np.arange(len(u)))
    fit = LocalLPVPipeline(restructurer=GrayBoxRestructurer(structure), time="time")
    fit.fit(X, y + 0.01 * y.std(axis=0) * noise)
    table["from data"] = fit.parameters_.iloc[0]
    table["+-"] = 2 * fit.parameters_std_.iloc[0]

    size = table["true"].abs()
    error = (table["from the response"] - table["true"]).abs() / size
    largest_errors[plant] = {
        "order": structure.order,
        "parameters": len(names),
        "from the response": error.max(),
        "from data": ((table["from data"] - table["true"]).abs() / size).median(),
        "within +-": ((table["from data"] - table["true"]).abs() < table["+-"]).mean(),
    }
    return table.map("{:.4g}".format)


# %%
# Masses in a chain
# -----------------
# .. math:: M \ddot q + D \dot q + K q = F u
#
# Three carriages, the first one tied to the wall, a force on the last. Springs
# and dampers between neighbours enter K and D with the same pattern. Forces are known
# (the 1 in F), so masses come out in kilograms.

chain = GrayBoxStructure.mechanical(
    M=[["m1", 0, 0], [0, "m2", 0], [0, 0, "m3"]],
    D=[["c1 + c2", "-c2", 0], ["-c2", "c2 + c3", "-c3"], [0, "-c3", "c3"]],
    K=[["k1 + k2", "-k2", 0], ["-k2", "k2 + k3", "-k3"], [0, "-k3", "k3"]],
    F=[[0], [0], [1]],
    outputs="position",
)
truth = {"m1": 1.2, "m2": 0.8, "m3": 1.0, "c1": 0.4, "c2": 0.6, "c3": 0.3}
truth |= {"k1": 90.0, "k2": 120.0, "k3": 60.0}
recover("mass chain", chain, truth, step=0.02)

# %%
# A flexible joint
# ----------------
# .. math::
#    \dot\varphi = \omega_m - \omega_l, \quad
#    J_m \dot\omega_m = \tau - k\varphi - d(\omega_m - \omega_l) - b_m \omega_m, \quad
#    J_l \dot\omega_l = k\varphi + d(\omega_m - \omega_l) - b_l \omega_l
#
# Motor, gear and link. Angles would drift away, and a black box must be stable
# to be compared: take the *twist* as a state, and measure speeds. What stands in
# front of a derivative goes into E.

joint = GrayBoxStructure.from_template(
    E=[[1, 0, 0], [0, "Jm", 0], [0, 0, "Jl"]],
    A=[[0, 1, -1], ["-k", "-d - bm", "d"], ["k", "d", "-d - bl"]],
    B=[[0], [1], [0]],
    C=[[0, 1, 0], [0, 0, 1]],
)
truth = {"Jm": 0.02, "Jl": 0.15, "k": 40.0, "d": 0.05, "bm": 0.1, "bl": 0.08}
recover("flexible joint", joint, truth, step=0.005)

# %%
# A DC motor
# ----------
# .. math:: L \dot i = v - R i - k \omega, \qquad J \dot\omega = k i - b \omega
#
# Parameters may stand in several places: the torque constant is the constant of the
# back-EMF, too. The speed alone tells three numbers, and there are five; the current
# tells the others.

motor = GrayBoxStructure.from_template(
    E=[["L", 0], [0, "J"]],
    A=[["-R", "-k"], ["k", "-b"]],
    B=[[1], [0]],
    C=[[1, 0], [0, 1]],
)
truth = {"L": 2e-3, "J": 4e-4, "R": 1.1, "k": 0.06, "b": 2e-3}
recover("DC motor", motor, truth, step=5e-4)

# %%
# What happens when the current is not measured: the restructurer says which
# combination of parameters the response does not change along.

import warnings

speed_only = GrayBoxStructure.from_template(
    E=[["L", 0], [0, "J"]], A=[["-R", "-k"], ["k", "-b"]], B=[[1], [0]], C=[[0, 1]]
)
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    GrayBoxRestructurer(speed_only).fit_model(speed_only.model(truth))
print(told[0].message)

# %%
# Numbers from an ohmmeter and an inductance meter mend that, too:
# ``speed_only.fix({"R": 1.1, "L": 2e-3})``.
#
# A drivetrain
# ------------
# Motor, gearbox and load on two shafts; the torque comes in, three speeds are measured.
# Two twists and three speeds are the states. Bounds keep a search where physics is.

drivetrain = GrayBoxStructure.from_template(
    E=[
        [1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, "J1", 0, 0],
        [0, 0, 0, "J2", 0],
        [0, 0, 0, 0, "J3"],
    ],
    A=[
        [0, 0, 1, -1, 0],
        [0, 0, 0, 1, -1],
        ["-k1", 0, "-d1 - b", "d1", 0],
        ["k1", "-k2", "d1", "-d1 - d2", "d2"],
        [0, "k2", 0, "d2", "-d2 - f"],
    ],
    B=[[0], [0], [1], [0], [0]],
    C=[[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]],
)
drivetrain = drivetrain.with_bounds(
    {name: (0, None) for name in drivetrain.parameter_names}
)
truth = {"J1": 0.2, "J2": 0.05, "J3": 0.6, "k1": 60.0, "k2": 35.0}
truth |= {"d1": 0.2, "d2": 0.3, "b": 0.25, "f": 0.5}
recover("drivetrain", drivetrain, truth, step=0.01)

# %%
# A quarter car
# -------------
# .. math::
#    m_s \ddot q_s &= -c (\dot q_s - \dot q_u) - k (q_s - q_u) \\
#    m_u \ddot q_u &= c (\dot q_s - \dot q_u) + k (q_s - q_u) - k_t (q_u - w)
#
# The input is the road w, no force: the tyre's stiffness stands in K and in F. Now
# nothing tells how heavy anything is. A car of twice the masses, springs and dampers
# moves alike: one number must be known, here the body's mass from a weighbridge.

car = GrayBoxStructure.mechanical(
    M=[[300, 0], [0, "mu"]],
    D=[["c", "-c"], ["-c", "c"]],
    K=[["k", "-k"], ["-k", "k + kt"]],
    F=[[0], ["kt"]],
    outputs="position",
)
truth = {"mu": 40.0, "c": 1500.0, "k": 16000.0, "kt": 190000.0}
recover("quarter car", car, truth, step=0.005)

# %%
# A room that is heated
# ---------------------
# .. math::
#    C_a \dot T_a &= P + g_{aw} (T_w - T_a) + g_v (T_o - T_a) \\
#    C_w \dot T_w &= g_{aw} (T_a - T_w) + g_w (T_o - T_w)
#
# A network of capacities and conductances: the air of a room and its walls. Inputs are
# the heating power in kW and the temperature outside; time counts in hours. Offsets of
# logged temperatures are found by ``offsets="auto"`` (:ref:`guide_points_of_work`).

room = GrayBoxStructure.from_template(
    E=[["Ca", 0], [0, "Cw"]],
    A=[["-gaw - gv", "gaw"], ["gaw", "-gaw - gw"]],
    B=[[1, "gv"], [0, "gw"]],
    C=[[1, 0], [0, 1]],
)
truth = {"Ca": 0.3, "Cw": 4.0, "gaw": 0.8, "gv": 0.05, "gw": 0.12}
recover("thermal RC", room, truth, step=0.25)

# %%
# Four tanks
# ----------
# Two pumps, whose flows divide between a tank below and one above another. Linearised
# about the levels of an operating point, every tank is a lag; their time constants
# follow the levels, which schedule. Positive rates alone make sense.

tanks = GrayBoxStructure.from_template(
    A=[["-a1", 0, "a3", 0], [0, "-a2", 0, "a4"], [0, 0, "-a3", 0], [0, 0, 0, "-a4"]],
    B=[["b1", 0], [0, "b2"], [0, "b3"], ["b4", 0]],
    C=[[1, 0, 0, 0], [0, 1, 0, 0]],
)
tanks = tanks.with_bounds({f"a{k}": (0, None) for k in (1, 2, 3, 4)})
truth = {"a1": 0.016, "a2": 0.011, "a3": 0.043, "a4": 0.033}
truth |= {"b1": 0.083, "b2": 0.063, "b3": 0.048, "b4": 0.031}
recover("four tanks", tanks, truth, step=4.0, clock=6)

# %%
# The short period of an aircraft
# -------------------------------
# .. math::
#    \dot\alpha = -Z_\alpha \alpha + q - Z_\delta \delta, \qquad
#    \dot q = -M_\alpha \alpha - M_q q - M_\delta \delta
#
# Angle of attack and pitch rate, the elevator deflects. The derivatives follow airspeed
# and altitude: two scheduling variables. The 1 in A is kinematics; leave it a number.

short_period = GrayBoxStructure.from_template(
    A=[["-Za", 1], ["-Ma", "-Mq"]], B=[["-Zd"], ["-Md"]], C=[[1, 0], [0, 1]]
)
truth = {"Za": 1.0, "Ma": 8.0, "Mq": 1.4, "Zd": 0.12, "Md": 11.0}
recover("short period", short_period, truth, step=0.02)

# %%
# A buck converter
# ----------------
# .. math::
#    L \dot{\imath} = V d - r i - v, \qquad C \dot v = i - g v
#
# Averaged over a period of switching: duty cycle in, current and voltage out, the
# supply V = 12 V is known. Numbers of very different sizes are no trouble.

converter = GrayBoxStructure.from_template(
    E=[["L", 0], [0, "C"]],
    A=[["-r", -1], [1, "-g"]],
    B=[[12], [0]],
    C=[[1, 0], [0, 1]],
)
truth = {"L": 47e-6, "C": 220e-6, "r": 0.08, "g": 0.25}
recover("buck converter", converter, truth, step=1e-5)

# %%
# A two-link arm
# --------------
# The paper's arm: joints in closed loop, links that bend. Linearised about an angle of
# the elbow it has sixteen parameters, which follow that angle.
# :class:`~lpvlearn.datasets.FlexibleArm` holds its structure and its true values.

from lpvlearn.datasets import FlexibleArm

arm = FlexibleArm()
recover("two-link arm", arm.structure(), arm.parameters(1.0), step=0.002, clock=8)

# %%
# All ten
# -------
# Largest relative error of a parameter from the response; median one from the data;
# and the share of the parameters whose true value is within two standard deviations,
# 95 % on average. Where the data tell a sum better than its parts, errors come in
# pairs: of the converter, resistance and load both damp.

summary = pd.DataFrame(largest_errors).T.astype({"order": int, "parameters": int})
formats = {"from the response": "{:.0e}", "from data": "{:.1%}", "within +-": "{:.0%}"}
summary.assign(**{name: summary[name].map(f.format) for name, f in formats.items()})
