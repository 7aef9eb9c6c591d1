r"""
.. _guide_refinement:

Refinement on data that moves
=============================

Local experiments show a system at rest points of the scheduling variable. How it
behaves while the variable moves, and between the points, they do not show. A few
experiments along which it moves do: :class:`~lpvlearn.OutputErrorLPV` fits the
coefficients of the interpolation to them,

.. math::

   \min_c \sum_k \|y_k - y_k(c)\|_W^2
   + (c - c_0)^{\mathsf T} \Lambda\, (c - c_0),

with the inverse variances W of what is left of every output, and with all that the
local experiments know of the coefficients, their information :math:`\Lambda`.
"""

# %%
# As the fourth step of a pipeline
# --------------------------------
# Local experiments on the flexible arm, in the state of coordinates and rates (see
# :ref:`guide_state_basis`: it leaves a term with the rate of the elbow out)...

import tempfile

import numpy as np
import pandas as pd

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    OutputErrorLPV,
    SubspaceLTI,
    fit_report,
    from_trajectories,
)
from lpvlearn.datasets import load_flexible_arm, prbs

data = load_flexible_arm()
dt = data.sampling_time

# %%
# ...and two sweeps with noise, in which the elbow turns through its range, one in
# either direction:

rng = np.random.default_rng(0)
sweeps = []
for direction, start in ((1, np.pi / 8), (-1, 7 * np.pi / 8)):
    u = prbs(3000, 2, amplitude=1.87, clock=5, balance=100, random_state=rng)
    u[:, 1] += direction * np.pi / 4
    response = data.arm.simulate(u, start, dt)
    noise = 0.03 * response.y.std(axis=0) * rng.standard_normal(response.y.shape)
    sweeps.append((u, response.kappa, response.y + noise))
X_moving, y_moving = from_trajectories(sweeps, sampling_time=dt)
X_moving["experiment"] += 1000
X = pd.concat([data.X, X_moving], ignore_index=True)
y = pd.concat([data.y, y_moving], ignore_index=True)

# %%
# All of them are one table. Experiments that stay at a point identify, those that move
# refine:

roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
memory = tempfile.mkdtemp()  # the local models are those of the next fit, too
pipeline = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False, horizon=60),
    GrayBoxRestructurer(data.structure),
    refiner=OutputErrorLPV(),
    memory=memory,
    **roles,
).fit(X, y)
pipeline.refiner_.report_.round(1)

# %%
# On a sweep that is new to both, from rest, before and after:

local = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False, horizon=60),
    GrayBoxRestructurer(data.structure),
    memory=memory,
    **roles,
).fit(data.X, data.y)
pd.concat(
    {
        name: fit_report(model, data.X_sweep, data.y_sweep).set_index("output")["BFT"]
        for name, model in (("local", local), ("refined", pipeline))
    },
    axis=1,
).round(1)

# %%
# Rate terms
# ----------
# What the state of coordinates and rates leaves out is a term with the rate of the
# scheduling variable, :math:`N(\kappa)\,\dot\kappa` in A. With ``rate="auto"`` such
# terms are tried in all rows of A that hold parameters, drawn to zero as strongly as is
# best for pieces of the sweeps that they were not fitted to, and kept where they lower
# the errors of these. Here they are:

pipeline.refiner_.rate_, pipeline.lpv_

# %%
# ``at`` gives the frozen model in motion, too:

(pipeline.lpv_.at(0.5, rate=-1.0).A - pipeline.lpv_.at(0.5).A).round(2)

# %%
# Where sweeps may mislead
# ------------------------
# A sweep in one direction fits as well with coefficients that are wrong in the other.
# Record both directions, and keep the prior: ``prior=None`` forgets the local
# experiments, ``prior=10`` counts them ten times. The weights of the outputs are those
# of what the model leaves, noise and the model's own errors together, so that a poor
# form cannot outvote precise local models by the number of its samples alone.
#
# Without local experiments
# -------------------------
# Alone, the estimator begins with one time-invariant model of the table: in a
# structure, or without one as a balanced model with matrices affine in the scheduling
# variables; or, where experiments of the table stay at three operating points or more,
# with the model through these, as a pipeline makes it. Without a structure it has the
# fewest states that do about as well as any, and outputs have constants where these
# leave little of the errors (``offset="auto"``). What it needs then is data that tell
# all coefficients:
#
# .. code-block:: python
#
#    OutputErrorLPV(structure, interpolator=RationalLPV(2, 2), **roles).fit(X, y)
#    OutputErrorLPV(lpv, **roles).fit(X, y)  # from a model that is known
