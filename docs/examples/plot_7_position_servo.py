"""
A position servo
================

A motor turns a load whose inertia depends on how far its arm is drawn out. What is
measured is the angle, so every model has an integrator: a pole at zero, which no record
tells from a slow one, and which makes the distance between two models infinite unless
their gains agree.

It is named twice. The structure has it with fixed entries: the first row of A says
that the angle changes with the speed, whatever the parameters. And the local models
are told which output has it.
"""

# %%
# Five positions of the arm, two records each, of an encoder with noise. The angle
# wanders off, as angles do.

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxStructure, from_trajectories
from lpvlearn.datasets import prbs

STEP = 0.02

servo = GrayBoxStructure.from_template(
    A=[[0, 1], [0, "-friction"]], B=[[0], ["gain"]], C=[[1, 0]]
)


def true_parameters(reach):
    inertia = 0.4 + 0.8 * reach**2  # kg m2
    return {"friction": 1.2 / inertia, "gain": 3.0 / inertia}


rng = np.random.default_rng(0)
trajectories = []
for k in range(10):
    reach = (0.2, 0.4, 0.6, 0.8, 1.0)[k % 5]
    torque = prbs(1000, clock=10, amplitude=1.0, random_state=k)
    angle = servo.model(true_parameters(reach)).simulate(torque, sampling_time=STEP)
    noise = 1e-3 * rng.standard_normal(angle.shape)
    trajectories.append((torque, reach, angle + noise))
X, y = from_trajectories(trajectories, sampling_time=STEP)
X = X.rename(columns={"u1": "torque", "kappa": "reach"})
y.columns = ["angle"]

# %%
# ``integrating="angle"`` identifies the rate of that output in its place, and
# integrates the model, exactly. The restructuring finds the integrator in the
# structure, and divides both models by it: the error is weighted by
# :math:`s / (s + c)`, where c is the slowest rate of the other poles.

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI

pipeline = LocalLPVPipeline(
    SubspaceLTI(integrating="angle"),
    GrayBoxRestructurer(servo),
    scheduling="reach",
    experiment="experiment",
    time="time",
).fit(X, y)
truth = pd.DataFrame(
    [true_parameters(reach) for reach in pipeline.operating_points_[:, 0]],
    index=pipeline.parameters_.index,
)
pipeline.parameters_.join(truth.add_suffix(" (true)")).round(3)

# %%
# The poles between the operating points: the integrator is at zero everywhere.

pd.DataFrame(
    np.sort_complex(pipeline.lpv_.frozen_poles(np.linspace(0.2, 1.0, 5)[:, None])),
    columns=["motor", "integrator"],
).round(3)

# %%
# A swing in which the arm is drawn out, which no experiment has shown. The truth is
# simulated with frozen coefficients at every sample.

t = STEP * np.arange(1500)
swing = 0.6 - 0.4 * np.cos(0.6 * t)
torque = prbs(1500, clock=25, amplitude=1.0, random_state=99)
x, angle = np.zeros(2), np.empty(1500)
for k in range(1500):
    frozen = servo.model(true_parameters(swing[k])).to_discrete(STEP)
    angle[k] = x[0]
    x = frozen.A @ x + frozen.B @ torque[k]

table = pd.DataFrame(
    {"torque": torque[:, 0], "reach": swing, "experiment": 0, "time": t}
)
predicted = pipeline.predict(table)

import matplotlib.pyplot as plt

fig, ax = plt.subplots(figsize=(6.5, 3), layout="constrained")
ax.plot(t, angle, color="black", label="truth")
ax.plot(t, predicted, "--", label="LPV model")
ax.set_xlabel("Time (s)")
ax.set_ylabel("Angle (rad)")
_ = ax.legend()
