r"""
.. _guide_data:

Data and column roles
=====================

All estimators take scikit-learn's ``X`` and ``y``. A row is a sampling instant; what a
column of ``X`` means is said by its *role*.

============================ ==========================================================
role                         the column holds
============================ ==========================================================
``inputs``                   :math:`u`; by default every column without another role
``scheduling``               :math:`\kappa`, what the dynamics depend on; default: none
``experiment``               a label; rows with one label are one record in time
``time``                     seconds, dates or time differences; checked, and read for
                             the step
``operating_point``          a label of the operating point; by default experiments are
                             grouped by their mean scheduling value
============================ ==========================================================

A role is given by a column's name (a tuple, where the columns are a MultiIndex), by the
name of a level of the index, or by a position (for arrays).
"""

# %%
# The library ships a small set of experiments on a simulated two-link arm with bending
# links: inputs are velocity references of its two joints, outputs the joint rates
# :math:`y_1, y_2`, and the dynamics depend on the elbow angle through
# :math:`\kappa = \cos\theta_2`.

from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
X, y = data.X, data.y
X.groupby("experiment").head(1).round(3)

# %%
# Seven experiments of 3 s at 1 kHz, with 30 dB of noise on the outputs. Within an
# experiment the elbow moves a little, which is allowed: a *local* experiment is one
# whose scheduling variable moves over a small part of the range between the points.

import matplotlib.pyplot as plt

one = (X["experiment"] == 3) & (X["time"] < 1.5)
fig, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 5), layout="constrained")
axes[0].plot(X["time"][one], X[["u1", "u2"]][one], lw=0.8, label=["u1", "u2"])
axes[1].plot(X["time"][one], y[one], lw=0.8, label=["y1", "y2"])
axes[2].plot(X["time"][one], X["kappa"][one], lw=0.8, color="k")
axes[0].set_ylabel("inputs (rad/s)")
axes[1].set_ylabel("outputs (rad/s)")
axes[2].set_ylabel("κ")
axes[2].set_xlabel("Time (s)")
for ax in axes[:2]:
    ax.legend(loc="upper right", ncols=2)

# %%
# What a good experiment is
# -------------------------
# * The inputs switch at random, each independently of the others (binary pseudo-random
#   signals: :func:`lpvlearn.datasets.prbs`). The time for which a bit is held decides
#   which frequencies are excited: some tenths of the fastest time constant of interest.
# * The record is long against the slowest time constant: a gain at standstill cannot
#   be read off a record in which the system never comes near it.
# * The operating points cover the range that the model is to be used in, and are close
#   enough for a polynomial to bridge the gaps. Three is the least for a parabola.
#
# The guards
# ----------
# Rows in a wrong order give no error in most libraries: just a useless model. Here the
# ``time`` column is checked. Shuffled rows, as a plain ``train_test_split`` makes them,
# are refused with a remedy:

from sklearn.model_selection import train_test_split

from lpvlearn import SubspaceLTI

part = X["experiment"] == 0
X_train, X_test, y_train, y_test = train_test_split(X[part], y[part], random_state=0)
model = SubspaceLTI(6, time="time", experiment="experiment", scheduling="kappa")
try:
    model.fit(X_train, y_train)
except ValueError as error:
    print(error)

# %%
# So is an experiment that is not local. The sweep of the arm visits the whole range; it
# is there to validate, not to identify local models:

from lpvlearn import LocalLPVPipeline

roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
try:
    LocalLPVPipeline(**roles).fit(data.X_sweep, data.y_sweep)
except ValueError as error:
    print(error)

# %%
# Forgotten roles
# ---------------
# A column without a role is an input, and a model with one input too many may fit well
# and mean nothing. What looks like something else is named in a warning: a column that
# rises evenly (the time), one that counts in blocks (the experiment), one that no
# experiment changes (the scheduling variable). Whoever lists the ``inputs`` is not
# doubted.

import warnings

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    SubspaceLTI(6, horizon=20, experiment="experiment", scheduling="kappa").fit(
        X[part], y[part]
    )
print(caught[0].message)

# %%
# Without a time column and without ``sampling_time``, a model counts time in samples:
# enough to simulate tables, and all that a discrete-time model needs. Where seconds are
# meant, for a structure, an LPV model, or ``to_continuous()``, that is an error rather
# than a second per sample; ``sampling_time=1`` says that samples are meant. A structure
# with fewer inputs than the table names the columns that were taken for inputs.
#
# Clocks that jitter, lost rows, missing values and other units of time have a
# :ref:`page of their own <guide_logs>`.
#
# Columns that are not numbers
# ----------------------------
# Labels may be text, times may be dates; inputs and scheduling variables are numbers. A
# smaller set than the arm, as it comes from a CSV file:

from lpvlearn.datasets import load_varying_spring

spring = load_varying_spring()
spring.X.groupby("run").head(1)

# %%
# Lists of trajectories
# ---------------------
# Records that come as a list of arrays become a table by
# :func:`~lpvlearn.from_trajectories`:

import numpy as np

from lpvlearn import from_trajectories

rng = np.random.default_rng(0)
trajectories = [
    (rng.standard_normal((100, 1)), 0.3, rng.standard_normal((100, 1))),
    (rng.standard_normal((80, 1)), 0.7, rng.standard_normal((80, 1))),
]
X_list, y_list = from_trajectories(trajectories, sampling_time=0.01)
X_list.groupby("experiment").agg(["min", "max"])
