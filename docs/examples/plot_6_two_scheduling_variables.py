"""
Two scheduling variables
========================

A drone's response to its throttle depends on the load *and* on the charge of the
battery. Nothing changes in the method: ``scheduling`` names two columns, the
polynomial has two variables.
"""

# %%
# Height rate over throttle, twelve operating points: four loads, three states of
# charge.

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxStructure, from_trajectories
from lpvlearn.datasets import prbs

STEP = 0.02

drone = GrayBoxStructure.from_template(
    A=[["-drag", "gain"], [0, "-lag"]], B=[[0], ["lag"]], C=[[1, 0]]
)


def true_parameters(load, charge):
    mass = 1.0 + load  # kg
    return {
        "drag": 0.4 / mass,
        "gain": (6.0 + 2.0 * charge) / mass,
        "lag": 5.0 + 3.0 * charge,
    }


rng = np.random.default_rng(0)
trajectories = []
points = [(load, charge) for load in (0.0, 0.2, 0.4, 0.6) for charge in (0.2, 0.6, 1.0)]
for k, point in enumerate(points):
    throttle = prbs(1500, clock=10, amplitude=0.1, random_state=k)
    rate = drone.model(true_parameters(*point)).simulate(throttle, sampling_time=STEP)
    noise = 0.03 * rate.std() * rng.standard_normal(rate.shape)
    trajectories.append((throttle, np.array([point]), rate + noise))
X, y = from_trajectories(trajectories, sampling_time=STEP)
X = X.rename(columns={"u1": "throttle", "kappa1": "load", "kappa2": "charge"})
X.groupby("experiment").first().head(4)

# %%
# Total degree 2: six terms (1, load, charge, load\ :sup:`2`, load x charge,
# charge\ :sup:`2`) for twelve points.

import tempfile

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, PolynomialLPV, SubspaceLTI

model = LocalLPVPipeline(
    SubspaceLTI(2, feedthrough=False),
    GrayBoxRestructurer(drone),
    PolynomialLPV(degree=2),
    scheduling=["load", "charge"],
    experiment="experiment",
    time="time",
    memory=tempfile.mkdtemp(),  # for another interpolator, below
).fit(X, y)
model.parameters_.round(3)

# %%
# The polynomial itself, a row for each parameter, a column for each term:

columns = ("load", "charge")
terms = [
    " x ".join(f"{name}^{p}" for name, p in zip(columns, powers, strict=True) if p)
    or "1"
    for powers in model.interpolator_.powers_
]
pd.DataFrame(
    model.interpolator_.coef_, index=model.parameters_.columns, columns=terms
).round(2)

# %%
# Where were the experiments, and how well does the interpolation fit there? A map for
# each parameter; dots that stand out of it are off.

from lpvlearn.inspection import ParameterDisplay, PoleDisplay, UncertaintyDisplay

units = {"gain": "m/s²", "drag": "1/s", "lag": "1/s", "load": "kg"}
display = ParameterDisplay.from_estimator(model, units=units)

# %%
# The poles, coloured by either variable:

display = PoleDisplay.from_estimator(model, units=units)

# %%
# What the model does not know: what noise leaves open over the range, and how far it is
# from the local models at the operating points.

display = UncertaintyDisplay.from_estimator(model, units=units)

# %%
# The frozen model anywhere in between, by name:

model.lpv_.at({"load": 0.3, "charge": 0.5}).poles()

# %%
# A flight in which a load is picked up and the battery runs down, both between the
# operating points. The truth is simulated with frozen coefficients at every sample.

t = STEP * np.arange(3000)
flight = np.column_stack([0.5 / (1 + np.exp(-(t - 30) / 3)), 1.0 - 0.75 * t / t[-1]])
throttle = prbs(3000, clock=10, amplitude=0.1, random_state=99)
x, truth = np.zeros(2), np.empty(3000)
for k in range(3000):
    frozen = drone.model(true_parameters(*flight[k])).to_discrete(STEP)
    truth[k] = x[0]
    x = frozen.A @ x + frozen.B @ throttle[k]

from lpvlearn import bft_score
from lpvlearn.inspection import SimulationDisplay

display = SimulationDisplay.from_predictions(
    t,
    truth,
    {
        "LPV": model.lpv_.simulate(throttle, flight, STEP),
        "frozen at the start": model.lpv_.at(flight[0]).simulate(
            throttle, sampling_time=STEP
        ),
    },
    units="m/s",
    true_name="truth",
    output_names=["height rate"],
)

# %%
# A new table with the same columns goes through ``predict``:

table = pd.DataFrame(
    {
        "throttle": throttle[:, 0],
        "load": flight[:, 0],
        "charge": flight[:, 1],
        "experiment": 0,
        "time": t,
    }
)
round(bft_score(truth, model.predict(table)), 2)

# %%
# Left out, the interpolator is ``AutoLPV()``. It finds what the parameters are here:
# products of straight lines in load and charge over a mass that both share.

model.set_params(interpolator=None).fit(X, y)
table_of_forms = model.interpolator_.selection_
table_of_forms[table_of_forms["aic"] < 300].round(1)

# %%
round(bft_score(truth, model.predict(table)), 2)
