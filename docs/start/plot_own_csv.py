"""
From a CSV file to an LPV model
===============================

A gantry crane carries a load on a rope. The shorter the rope, the faster the load
swings, so no single linear model describes the crane: its dynamics depend on the rope
length, which is measured. That is the situation this library is for.

This page goes the whole way: a table in a CSV file, a model, a check on a record that
the model has never seen, and the model's use.
"""

# %%
# Read it
# -------
# At five rope lengths, somebody shook the trolley for 40 seconds and recorded the swing
# angle, every 0.05 s. The file ships with the library; any other CSV file will do as
# well. One row is one sampling instant, one column says which run a row belongs to.

import numpy as np
import pandas as pd

from lpvlearn.datasets import data_folder

table = pd.read_csv(data_folder() / "gantry_crane.csv")
table.groupby("run").head(2)

# %%
# Fit
# ---
# Tell which column has which *role*: ``scheduling`` is the variable that the dynamics
# depend on, ``experiment`` separates the runs, ``time`` lets the library check that no
# sample is missing. Every other column of ``X`` is an input.

from lpvlearn import LocalLPVPipeline

roles = {"scheduling": "rope", "experiment": "run", "time": "time"}
X, y = table[["run", "time", "acceleration", "rope"]], table["angle"]

black_box = LocalLPVPipeline(**roles).fit(X, y)
black_box.report_[["n_samples", "order", "horizon", "local_BFT"]].round(2)

# %%
# Five operating points were found, a model of order 2 was identified at each, all were
# brought into one common form and interpolated over the rope length. ``local_BFT`` is
# the fit of the local models in percent: 100 is perfect, and noise in the record costs
# some of it.
#
# Bring in what you know
# ----------------------
# We know more than that: the load is a pendulum. Its equation has three unknown numbers
# at every rope length, the stiffness ``k`` (gravity over length), the damping ``c`` and
# the gain ``b``. Write them down as names in a template:

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure

pendulum = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]],
    B=[[0], ["-b"]],
    C=[[1, 0]],
)
crane = LocalLPVPipeline(restructurer=GrayBoxRestructurer(pendulum), **roles)
crane.fit(X, y)
crane.parameters_.round(3)

# %%
# No starting value was needed, and the numbers have a meaning: ``k`` should be 9.81
# divided by the rope length, ``b`` one divided by it. The warning is right, too: a
# real pendulum follows the sine of its angle, and at some points the noise is too small
# to hide that.

length = crane.parameters_.index
truth = pd.DataFrame({"b": 1 / length, "k": 9.81 / length}, index=length)
truth.round(3)

# %%
# Their course over the rope length, with what interpolates them:

from lpvlearn.inspection import ParameterDisplay, SimulationDisplay

display = ParameterDisplay.from_estimator(crane)

# %%
# Between the points
# ------------------
# The library tries polynomials and fractions over the rope length, and takes the
# simplest that meets the points up to their noise. Here a fraction, as it should be:

print(crane.interpolator_.form_)
crane.report_[["relative_error", "interpolation_error"]].round(4)

# %%
# ``relative_error`` is the distance from the black box to the pendulum at each point,
# ``interpolation_error`` that from the pendulum there to the interpolated one, relative
# to the model's own size: both below one per cent.
#
# Check
# -----
# The test record was not used, and the rope moved during it. ``predict`` simulates the
# model from rest; it never sees the measured angle.

from lpvlearn import bft_score, fit_report

test = pd.read_csv(data_folder() / "gantry_crane_hoisting.csv")
X_test = test[X.columns]
fit_report(crane, X_test, test["angle"]).round(3)

# %%
display = SimulationDisplay.from_estimator(crane, X_test, test["angle"], units="rad")

# %%
# All there is to see of a model, on one page:

from lpvlearn.inspection import plot_overview

page = plot_overview(crane, X_test, test["angle"], units={"angle": "rad"})

# %%
# What is left is noise, and a term that no local experiment can show: while the rope is
# hoisted, its speed acts on the swing. The model depends on the scheduling variable,
# not on its rate of change; :ref:`guide_state_basis` tells how it may.
#
# What would a model without scheduling have given? Fit one linear model to all runs:

from lpvlearn import SubspaceLTI

one_model = SubspaceLTI(2, **roles).fit(X, y)
pd.Series(
    {
        "one linear model": bft_score(test["angle"], one_model.predict(X_test)),
        "LPV model": bft_score(test["angle"], crane.predict(X_test)),
    },
    name="BFT (%)",
).round(1)

# %%
# Use
# ---
# ``lpv_`` is the model itself: matrices at any rope length, poles,
# simulation.

crane.lpv_.at(1.2).A

# %%
# Swing frequency (rad/s) and damping at three lengths that were never measured:

rope = pd.Index([1.2, 1.8, 2.7], name="rope")
poles = crane.lpv_.frozen_poles(rope)
pd.DataFrame(
    {"frequency": np.abs(poles[:, 0]), "real part": poles[:, 0].real}, index=rope
).round(3)

# %%
# All of this without Python, from a file to a report: :ref:`command`.
#
# **Next.** The :ref:`user guide <user_guide>` explains each step;
# :ref:`coming_from_sklearn` tells how to cross-validate such a model,
# :ref:`coming_from_matlab` which function replaces which.
