"""
Cross-validation and model selection
====================================

scikit-learn's tools work on dynamic models, provided that a split respects what the
rows are: samples of experiments, in the order of time. This page goes through them on
a motor whose dynamics depend on its load.
"""

# %%
# Seven loads, two experiments at each; the scheduling variable is the load.

import tempfile
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from lpvlearn import StateSpace, from_trajectories
from lpvlearn.datasets import prbs

STEP = 0.02


def motor(load):
    """Armature current and speed; the inertia grows with the load."""
    inertia = 0.2 + load
    return StateSpace(
        [[-2.0, -1.5], [1.5 / inertia, -0.3 / inertia]], [[2.0], [0.0]], [[0.0, 1.0]]
    )


rng = np.random.default_rng(0)
trajectories = []
for run in range(14):
    load = 0.1 + 0.15 * (run // 2)
    voltage = prbs(1000, clock=8, random_state=run)
    speed = motor(load).simulate(voltage, sampling_time=STEP)
    noise = 0.03 * speed.std() * rng.standard_normal(speed.shape)
    trajectories.append((voltage, load, speed + noise))
X, y = from_trajectories(trajectories, sampling_time=STEP)
X = X.rename(columns={"kappa": "load"})

# %%
# The model: physics with three unknown numbers at every load. (Freeing the entry -2.0
# as well would leave four numbers for three coefficients of the transfer function; the
# library warns of that, naming the combination that no experiment can tell.)

from lpvlearn import (
    ExperimentSplit,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_scorer,
    make_bft_scorer,
    vaf_scorer,
)

structure = GrayBoxStructure.from_template(
    A=[[-2.0, "-e"], ["m", "-f"]], B=[[2.0], [0]], C=[[0, 1]]
)
model = LocalLPVPipeline(
    SubspaceLTI(2, horizon=20, feedthrough=False),
    GrayBoxRestructurer(structure),
    PolynomialLPV(degree=2),
    scheduling="load",
    experiment="experiment",
    time="time",
    memory=tempfile.mkdtemp(),
)

# %%
# Several scores at once
# ----------------------
# ``ExperimentSplit`` deals whole experiments to the folds, those of every operating
# point evenly.

from sklearn.model_selection import cross_validate

cv = ExperimentSplit(2, experiment="experiment", scheduling="load")
scores = cross_validate(
    model,
    X,
    y,
    cv=cv,
    scoring={"BFT": bft_scorer, "VAF": vaf_scorer, "R2": "r2"},
)
pd.DataFrame(scores).filter(like="test").round(3)

# %%
# Points that training has not seen
# ---------------------------------
# scikit-learn's ``LeaveOneGroupOut``, a group for each load. The two outermost loads
# are extrapolated; the library warns of that, as it should. To choose a degree, leave
# out the others only (below).

from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    left_out = cross_val_score(
        model,
        X,
        y,
        groups=X["load"].round(6),
        cv=LeaveOneGroupOut(),
        scoring=bft_scorer,
    )
pd.Series(left_out, index=X["load"].round(2).unique(), name="BFT (%)").round(1)

# %%
# A grid over all three steps
# ---------------------------
# Nested parameters are named with two underscores. Local and gray-box models are kept
# on disk (``memory=``), so that a further degree costs next to nothing. Interior points
# only are left out, and the models scored over the whole range: see
# :ref:`guide_validation` for both.

from sklearn.model_selection import GridSearchCV

inside = ExperimentSplit(
    "all",
    experiment="experiment",
    scheduling="load",
    hold_out="operating_point",
    interior=True,
    test_on="all",
)
search = GridSearchCV(
    model,
    {"local__horizon": [10, 20], "interpolator__degree": [1, 2, 3, 4]},
    cv=inside,
    scoring=make_bft_scorer(average="experiment"),
).fit(X, y)
pd.DataFrame(search.cv_results_).pivot_table(
    "mean_test_score", "param_interpolator__degree", "param_local__horizon"
).round(2)

# %%
# The horizon makes no difference here: the refinement of the local models forgets it.
# ``search`` is now the best model, refitted to all experiments.

print(search.best_params_)

# %%
# How many experiments are enough?
# --------------------------------
# ``learning_curve`` takes the first rows of every training set. ``ExperimentSplit``
# puts one experiment of every load before the second of any, so that a part of the rows
# still covers the range.

from sklearn.model_selection import learning_curve

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # few experiments do not cover all loads
    sizes, _, test = learning_curve(
        model, X, y, cv=cv, train_sizes=[0.6, 0.8, 1.0], scoring=bft_scorer
    )
curve = pd.Series(test.mean(1), index=pd.Index(sizes, name="training rows"))
fig, ax = plt.subplots(figsize=(6, 3), layout="constrained")
curve.plot(ax=ax, style="o-", ylabel="BFT (%)")
curve.round(2)

# %%
# Which columns matter?
# ---------------------
# Roles may also be levels of the index. Then only inputs are columns of ``X``, and
# ``permutation_importance`` shuffles nothing else. A second input
# that does nothing, and black boxes, which allow for it:

from sklearn.inspection import permutation_importance

X_wide = X.assign(idle=rng.choice([-1.0, 1.0], len(X)))
X_wide = X_wide.set_index(["experiment", "time", "load"])
wide = search.best_estimator_.set_params(restructurer="aligned").fit(X_wide, y)
importance = permutation_importance(
    wide, X_wide, y, scoring=bft_scorer, n_repeats=2, random_state=0
)
pd.Series(
    importance["importances_mean"], index=X_wide.columns, name="loss of BFT (%)"
).round(1)

# %%
# What does not work, and says so
# -------------------------------
# A split that shuffles rows leaves no experiment intact:

from sklearn.model_selection import KFold

try:
    cross_val_score(model, X, y, cv=KFold(3, shuffle=True), error_score="raise")
except ValueError as error:
    print(error)

# %%
# In the middle of an experiment
# ------------------------------
# Test parts that start in mid-motion need an initial state; the scorer can estimate it
# from the outputs, or leave the first samples out. From rest the score is wrong, as the
# library says.

from lpvlearn import BlockedTimeSeriesSplit

in_time = BlockedTimeSeriesSplit(n_splits=3, experiment="experiment")
rows = {
    "from rest": bft_scorer,
    "initial state estimated": make_bft_scorer(initial_state="estimate"),
    "first 2 s not scored": make_bft_scorer(burn_in=100),
}
pd.DataFrame(
    {
        name: cross_val_score(model, X, y, cv=in_time, scoring=scorer)
        for name, scorer in rows.items()
    }
).round(1)
