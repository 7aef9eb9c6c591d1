r"""
.. _guide_bands:

How certain a prediction is
===========================

A simulation may be wrong for two reasons, which are told apart:

- the **parameters** are uncertain: experiments are short, and have noise. Their
  covariance is carried through the interpolation to its coefficients, and by exact
  derivatives from there to parameters, frequency responses and simulated outputs;
- the **model** is not true: no form of the interpolation, state or order is. No
  precision of coefficients helps against that. It shows in what the model leaves of
  measured outputs, but for the noise.
"""

# %%
# A model of the flexible arm from local experiments, in the state of coordinates and
# momenta (see :ref:`guide_state_basis`), and the same refined on two sweeps with noise
# (see :ref:`guide_refinement`):

import tempfile

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    OutputErrorLPV,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.datasets import load_flexible_arm, prbs
from lpvlearn.inspection import BodeDisplay, ParameterDisplay

data = load_flexible_arm()


def sweeps(seed, noise):
    """Two experiments in which the elbow turns through its range, up and down."""
    rng, runs = np.random.default_rng(seed), []
    for direction, start in ((1, np.pi / 8), (-1, 7 * np.pi / 8)):
        u = prbs(3000, 2, amplitude=1.87, clock=5, balance=100, random_state=rng)
        u[:, 1] += direction * np.pi / 4
        found = data.arm.simulate(u, start, data.sampling_time)
        error = noise * found.y.std(axis=0) * rng.standard_normal(found.y.shape)
        runs.append((u, found.kappa, found.y + error))
    return from_trajectories(runs, sampling_time=data.sampling_time)


X_moving, y_moving = sweeps(seed=0, noise=0.03)
X_moving["experiment"] += 1000
X = pd.concat([data.X, X_moving], ignore_index=True)
y = pd.concat([data.y, y_moving], ignore_index=True)

steps = {
    "local": SubspaceLTI(6, feedthrough=False, horizon=60),
    "restructurer": GrayBoxRestructurer(data.arm.structure("momentum")),
    "scheduling": "kappa",
    "experiment": "experiment",
    "time": "time",
    "memory": tempfile.mkdtemp(),  # both begin with the same local models
}
local = LocalLPVPipeline(**steps).fit(data.X, data.y)
refined = LocalLPVPipeline(refiner=OutputErrorLPV(), **steps).fit(X, y)

# %%
# Bands of a simulation
# ---------------------
# As scikit-learn's regressors that know it, ``predict`` takes ``return_std=True``. On
# new sweeps without noise:

X_new, y_new = sweeps(seed=100, noise=0.0)
y_pred, std = refined.predict(X_new, return_std=True)

parts = refined.prediction_std(X_new)
up = (X_new["experiment"] == 0).to_numpy()
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 4), layout="constrained")
for k, (ax, name) in enumerate(zip(axes, y_new.columns, strict=True)):
    time = X_new["time"][up]
    for part, shade in (("total", "0.85"), ("parameters", "#E69F00")):
        width = 1.96 * parts[name, part][up]
        ax.fill_between(time, -width, width, color=shade, lw=0, label=part)
    ax.plot(time, (y_new[name] - y_pred[:, k])[up], "k", lw=0.7, label="error")
    ax.set_ylabel(f"{name}, error")
axes[0].legend(ncols=3, loc="upper left", frameon=False)
_ = axes[1].set_xlabel("Time (s)")

# %%
# (``SimulationDisplay.from_estimator(refined, X_new, y_new, uncertainty=True)`` draws
# the outputs themselves with their bands.) The parts, in the units of the outputs, are
# columns of ``prediction_std``:
#
# - "parameters": by the covariance of the coefficients, ``lpv_.covariance``;
# - "model_error": the model's own error, the same at all times;
# - "total": of the output without noise, the root of the sum of both squares. This is
#   what ``predict`` returns;
# - "measurement": of an output that will be measured, with the noise too.

parts[["y1"]].iloc[[10, 1000, 2000]].round(5)

# %%
# Where the model's own error comes from
# --------------------------------------
# ``output_errors_`` has the levels. What is white of the errors counts as noise, by the
# quietest of eight bands of frequencies; the rest is the model's own. A refinement fits
# some of that, on its own records only: therefore every quarter of a record is left out
# in turn, and the model error is that of models which have not seen it.
#
# Without data that move, the local experiments must do. They show how far the
# interpolation is from the local models, but nothing of what happens while the
# scheduling variable moves, nor at other points:

pd.concat({"local": local.output_errors_, "refined": refined.output_errors_}).round(4)

# %%
# Within its 95 % bands, a model should have 95 % of new outputs. The refined one is
# about right, for sweeps of the kind that it was refined on; with local experiments
# alone the bands are those of a model that is true in motion, and too narrow:


def inside(pipeline, part):
    std = pipeline.prediction_std(X_new).xs(part, axis=1, level="part")
    error = np.abs(pipeline.predict(X_new) - y_new.to_numpy())
    return 100 * (error < 1.96 * std.to_numpy()).mean()


pd.DataFrame(
    {
        name: {part: inside(pipeline, part) for part in ("parameters", "total")}
        for name, pipeline in (("local", local), ("refined", refined))
    }
).round(1)

# %%
# On motions twice as fast, or inputs three times as large, what a model misses is
# larger, and no figure from other motions tells by how much: refine on motions like
# those that the model is for.
#
# Bands of parameters and of responses
# ------------------------------------
# These are of the coefficients alone. Bars are the local parameters, each from its own
# experiments; the interpolation, which all points hold, is more certain:

names = local.parameters_.columns[:8]
display = ParameterDisplay.from_estimator(local, names=names, uncertainty=True)

# %%
# In numbers, and for the frozen model at a scheduling value that no experiment had:

theta, theta_std = local.lpv_.parameters([0.1, 0.5], return_std=True)
omega = np.geomspace(1, 300, 400)
G_std = local.lpv_.frequency_response_std(0.5, omega)
display = BodeDisplay.from_estimator(local, kappa=0.5, omega=omega, uncertainty=True)
plt.show()

# %%
# What is known, and when
# -----------------------
# ``lpv_.covariance`` is None, and the bands are refused, where the covariances of the
# local parameters are not known (aligned black boxes, or one that does not minimise the
# simulation error), or the interpolation has no coefficients (a regressor of another
# library). A refinement knows it always. Where no form of the interpolation
# meets the points as well as their covariances allow, what is left of them is the
# form's own error: the covariance is then multiplied by chi-square per degree of
# freedom. Offsets of points of work, delays and the state at the start count as known.
