r"""
.. _guide_validation:

Validation and cross-validation
===============================

A model is as good as its simulation of data that it has never seen.
"""

# %%
# Measures
# --------
# The best fit ratio and the variance accounted for, Eq. (33) of the paper, in percent
# and for each output :math:`k`:
#
# .. math::
#
#    \mathrm{BFT}_k &= 100 \max\!\Big(1 - \frac{\|y_k - \hat y_k\|}{\|y_k - \bar y_k\|},
#    0\Big) \\
#    \mathrm{VAF}_k &= 100 \max\!\Big(1 - \frac{\mathrm{var}(y_k - \hat y_k)}
#    {\mathrm{var}(y_k)}, 0\Big)
#
# BFT is the stricter: an error of 10 % of the signal is a BFT of 90, but a VAF of 99.
# BFT is the *fit* of MATLAB's ``compare``. ``score`` of an estimator is :math:`R^2`, as
# in all of scikit-learn: :math:`\mathrm{BFT} = 100\,(1 - \sqrt{1 - R^2})` for one
# output.

import tempfile

import matplotlib.pyplot as plt
import pandas as pd

from lpvlearn import (
    ExperimentSplit,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_scorer,
    compare_models,
    fit_report,
)
from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
memory = tempfile.mkdtemp()  # of local and gray-box models, see below
pipeline = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False, horizon=60),
    GrayBoxRestructurer(data.structure),
    memory=memory,
    **roles,
).fit(data.X, data.y)

# %%
# Reports
# -------
# One row per experiment and output, on new noise-free local experiments...

fit_report(pipeline, data.X_local, data.y_local).round(2).head(6)

# %%
# ...and on the sweep, in which the elbow moves fast. A local experiment tests the
# frozen models, the sweep the LPV model: do both.

fit_report(pipeline, data.X_sweep, data.y_sweep).round(2)

# %%
# Every step of the fit leaves its own figures: if the end result is poor, the first
# poor one tells the step to look at.

print(pipeline.summary())

# %%
# Several models on one table, here with the paper's baseline, which interpolates the
# balanced models without a common structure:

balanced = LocalLPVPipeline(
    SubspaceLTI(6, feedthrough=False, horizon=60),
    "passthrough",
    memory=memory,
    **roles,
).fit(data.X, data.y)
compare_models(
    {"restructured": pipeline, "balanced": balanced}, data.X_sweep, data.y_sweep
).pivot_table(["BFT", "VAF"], "model", "output").round(1)

# %%
# Residuals
# ---------
# A good fit may hide what the errors know. A complete model leaves errors that are
# independent of the *past inputs*, else it lacks states, a delay or a nonlinearity; of
# the *present* one, else it lacks a feedthrough; and of *future inputs*, else there
# was feedback from the outputs to the inputs, and the identification is biased. Where
# the errors are *white* as well, simulating is as good as predicting.
# :meth:`~lpvlearn.SubspaceLTI.residual_tests` tests all of it; coloured noise raises no
# alarm with the inputs. Here a local model has five states, one less than the arm:

from lpvlearn.inspection import ResidualDisplay

first = data.X["experiment"] == 0
few = SubspaceLTI(5, feedthrough=False, horizon=60, inputs=["u1", "u2"])
few.fit(data.X[first], data.y[first])
tests = few.residual_tests(data.X[first], data.y[first])
tests[~tests["passed"]]

# %%
# :class:`~lpvlearn.inspection.ResidualDisplay` shows the correlations behind it: the
# errors leave the band at positive lags, most with the torque of the second motor.

display = ResidualDisplay.from_estimator(few, data.X[first], data.y[first])

# %%
# Six states pass. These are the samples of the fit, and the p-values allow for the
# parameters that were fitted to them; on others a model is tested as it is, with the
# errors that its parameters have.

SubspaceLTI(6, feedthrough=False, horizon=60, inputs=["u1", "u2"]).fit(
    data.X[first], data.y[first]
).residual_tests(data.X[first], data.y[first])

# %%
# Leave one operating point out
# -----------------------------
# The honest question to an LPV model: how well does it describe the system where it was
# not identified? :class:`~lpvlearn.ExperimentSplit` holds out whole experiments or, as
# here, whole operating points.
#
# Leave out *interior* points only (``interior=True``). Without an outermost point the
# others would be extrapolated, which nobody will ask of the model; the error of that
# grows with the degree of the polynomial and drowns everything else.
# (scikit-learn's ``LeaveOneGroupOut`` with a column of groups leaves out all of them.)

from sklearn.model_selection import GridSearchCV, cross_val_score

points = {
    "n_splits": "all",
    "experiment": "experiment",
    "scheduling": "kappa",
    "hold_out": "operating_point",
    "interior": True,
}
scores = cross_val_score(
    pipeline, data.X, data.y, cv=ExperimentSplit(**points), scoring=bft_scorer
)
pd.Series(scores, name="BFT (%)").round(1)

# %%
# Choose the degree
# -----------------
# Each of these scores is a pessimist: it is taken in the middle of a gap twice as wide
# as any that the final model has, and the gap weighs the more, the higher the degree.
# Of few operating points it chooses degrees that are too low. So score every model that
# lacks a point over the *whole* range, where the gap is one place among others
# (``test_on="all"``). The mean over experiments stands for the mean over the range;
# ``average="experiment"`` lets each of them count alike, whatever the size of its
# outputs.
#
# In return most test samples were in training. That is harmless as long as the noise in
# the local models is small beside the error of interpolation between them. It flatters
# high degrees where it is not, and then the score at the points left out chooses
# better. Compare both columns below; where they disagree by much, ask for more points
# or longer records.
#
# Nested parameters are named with two underscores. ``memory=`` keeps local and gray-box
# models on disk: a search over the interpolator identifies and restructures nothing
# twice.

from lpvlearn import make_bft_scorer

by_degree = pd.DataFrame(index=pd.RangeIndex(1, 5, name="degree"))
for name, test_on in (("at the point left out", "held_out"), ("on the range", "all")):
    search = GridSearchCV(
        pipeline.set_params(interpolator=PolynomialLPV()),
        {"interpolator__degree": list(by_degree.index)},
        cv=ExperimentSplit(**points, test_on=test_on),
        scoring=make_bft_scorer(average="experiment"),
    ).fit(data.X, data.y)
    by_degree[name] = search.cv_results_["mean_test_score"]

# %%
# What is chosen without one point at a time, the sweep confirms. It was not used to
# choose. (Over twelve sets of experiments: :ref:`how_good`.)

by_degree["sweep"] = [
    bft_scorer(
        pipeline.set_params(interpolator__degree=degree).fit(data.X, data.y),
        data.X_sweep,
        data.y_sweep,
    )
    for degree in by_degree.index
]
fig, ax = plt.subplots(figsize=(6, 3), layout="constrained")
styles = ["o:", "o-", "s--"]
by_degree.plot(ax=ax, style=styles, xticks=by_degree.index, ylabel="BFT (%)")
by_degree.round(1)

# %%
# Splits in time
# --------------
# With one long experiment per point, hold out its later part:
# :class:`~lpvlearn.BlockedTimeSeriesSplit` cuts every experiment at the same places
# (scikit-learn's ``TimeSeriesSplit`` cuts the *table*, whose later rows are other
# experiments). The test part then starts in the middle of a motion, and a simulation
# from rest is wrong there, as a warning says. Let the scorer estimate the initial
# state, and say so when you report the result:

from lpvlearn import BlockedTimeSeriesSplit

here = data.X["experiment"] == 0
in_time = BlockedTimeSeriesSplit(n_splits=2, experiment="experiment")
scores = {
    state: cross_val_score(
        SubspaceLTI(6, feedthrough=False, horizon=40, inputs=["u1", "u2"]),
        data.X[here],
        data.y[here],
        cv=in_time,
        scoring=make_bft_scorer(initial_state=state),
    )
    for state in ("rest", "estimate")
}
pd.DataFrame(scores).round(1)
