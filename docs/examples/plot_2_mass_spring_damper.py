"""
A mass on a spring of varying stiffness
=======================================

The smallest LPV system: one input, one output, one scheduling variable. A mass of 2
kg hangs on a spring whose stiffness depends on the temperature; the input is a force,
the output the position. Which numbers of the physics can be recovered, and how
exactly?
"""

# %%
# Experiments at five temperatures, one minute each at 50 Hz, with 30 dB of noise.

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxStructure, StateSpace, from_trajectories
from lpvlearn.datasets import prbs

MASS, DAMPING = 2.0, 1.2  # kg, N s/m
STEP = 0.02  # s


def stiffness(temperature):
    """N/m; softer when warm."""
    return 60.0 - 0.4 * temperature + 0.002 * temperature**2


def spring_system(temperature):
    A = [[0, 1], [-stiffness(temperature) / MASS, -DAMPING / MASS]]
    return StateSpace(A, [[0], [1 / MASS]], [[1, 0]])


rng = np.random.default_rng(0)
temperatures = [0.0, 20.0, 40.0, 60.0, 80.0]
trajectories = []
for k, temperature in enumerate(temperatures):
    force = prbs(3000, clock=10, amplitude=5.0, random_state=k)
    position = spring_system(temperature).simulate(force, sampling_time=STEP)
    noise = 10 ** (-30 / 20) * position.std() * rng.standard_normal(position.shape)
    trajectories.append((force, temperature, position + noise))
X, y = from_trajectories(trajectories, sampling_time=STEP)
X = X.rename(columns={"kappa": "temperature"})

# %%
# Newton's law is the structure. All three numbers are left free: stiffness over mass
# ``k``, damping over mass ``c`` and one over mass ``b``.

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI

newton = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
)
model = LocalLPVPipeline(
    SubspaceLTI(feedthrough=False),
    GrayBoxRestructurer(newton),
    scheduling="temperature",
    experiment="experiment",
    time="time",
).fit(X, y)
print(model.summary())

# %%
# Back to physical units, with the truth beside:

found = model.parameters_
physical = pd.DataFrame(
    {
        "mass": 1 / found["b"],
        "damping": found["c"] / found["b"],
        "stiffness": found["k"] / found["b"],
        "true stiffness": stiffness(found.index.to_numpy()),
    }
)
physical.round(3)

# %%
# Stiffness over temperature. The polynomial smooths what noise is left in single
# points.

from lpvlearn.inspection import ParameterDisplay, PoleDisplay, SimulationDisplay

display = ParameterDisplay.from_estimator(model, n_columns=3)

# %%
# Validation while the temperature changes. The truth is simulated in small steps with
# frozen coefficients, which is exact for this system: no term with the rate of the
# temperature exists.

warming = np.linspace(0.0, 80.0, 3000)
force = prbs(3000, clock=10, amplitude=5.0, random_state=99)
x, truth = np.zeros(2), np.empty(3000)
for k in range(3000):
    truth[k] = x[0]
    step = spring_system(warming[k]).to_discrete(STEP)
    x = step.A @ x + step.B @ force[k]
simulated = model.lpv_.simulate(force, warming, STEP)
display = SimulationDisplay.from_predictions(
    STEP * np.arange(3000),
    truth,
    simulated,
    units="m",
    true_name="truth",
    output_names=["position"],
)

# %%
# Poles over temperature, from 0 to 80 degrees:

display = PoleDisplay.from_estimator(model)
limits = display.ax_.set_xlim(-0.6, 0.05)
