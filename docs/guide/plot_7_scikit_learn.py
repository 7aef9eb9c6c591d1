"""
.. _guide_tools:

scikit-learn's tools, one by one
================================

A snippet for each tool, on a mass whose spring stiffens with ``kappa``. Two rules carry
all of them: a fold holds whole experiments, and columns have :ref:`roles <guide_data>`.
"""

# %%
# Two experiments at each of five operating points, 2 % noise, and a pipeline with a
# fixed horizon, so that the page is built quickly.

import tempfile

import numpy as np
import pandas as pd

from lpvlearn import (
    BlockedTimeSeriesSplit,
    ExperimentSplit,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
    bft_scorer,
    from_trajectories,
    make_bft_scorer,
    vaf_scorer,
)
from lpvlearn.datasets import load_varying_spring, prbs

spring = load_varying_spring().structure
rng = np.random.default_rng(0)
records = []
for run, kappa in enumerate(np.repeat([0.0, 0.4, 0.8, 1.2, 1.6], 2)):
    force = prbs(400, clock=4, random_state=run)
    truth = spring.model({"b": 30.0, "c": 1.2, "k": 40.0 + 20.0 * kappa**2})
    position = truth.simulate(force, sampling_time=0.02)
    noise = 0.02 * position.std() * rng.standard_normal(position.shape)
    records.append((force, kappa, position + noise))
X, y = from_trajectories(records, sampling_time=0.02)

roles = {"scheduling": "kappa", "experiment": "experiment"}
model = LocalLPVPipeline(
    SubspaceLTI(2, horizon=10, feedthrough=False),
    GrayBoxRestructurer(spring),
    PolynomialLPV(degree=2),
    time="time",
    memory=tempfile.mkdtemp(),  # splits share points, which are identified once
    **roles,
)
X.head(3)

# %%
# Scores
# ------
# **cross_validate** with several scorers. :class:`~lpvlearn.ExperimentSplit` deals the
# experiments of every operating point evenly to the folds.

from sklearn.model_selection import cross_validate

scores = cross_validate(
    model,
    X,
    y,
    cv=ExperimentSplit(2, **roles),
    scoring={"BFT": bft_scorer, "VAF": vaf_scorer, "R2": "r2"},
)
pd.DataFrame(scores).filter(like="test_").round(3)

# %%
# **LeaveOneGroupOut over operating points**: how well is each predicted by the others?
# The groups are scheduling values. The outermost two are extrapolated.

import warnings

from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

from lpvlearn.exceptions import ExtrapolationWarning

options = {"cv": LeaveOneGroupOut(), "scoring": bft_scorer}
with warnings.catch_warnings():
    warnings.simplefilter("ignore", ExtrapolationWarning)
    print(cross_val_score(model, X, y, groups=X["kappa"], **options).round(1))

# %%
# **LeaveOneGroupOut over experiments**: how well is a new experiment predicted?

print(cross_val_score(model, X, y, groups=X["experiment"], **options).round(1))

# %%
# **GroupKFold**: the same with fewer folds. It deals without regard to operating
# points: a fold may take both experiments of one away.

from sklearn.model_selection import GroupKFold

with warnings.catch_warnings():
    warnings.simplefilter("ignore", ExtrapolationWarning)
    print(
        cross_val_score(
            model, X, y, groups=X["experiment"], cv=GroupKFold(5), scoring=bft_scorer
        ).round(1)
    )

# %%
# **BlockedTimeSeriesSplit**: earlier parts of all experiments train, later ones test. A
# test part begins in mid-motion, so that the scorer must estimate where.

print(
    cross_val_score(
        model,
        X,
        y,
        cv=BlockedTimeSeriesSplit(2, gap=20, experiment="experiment"),
        scoring=make_bft_scorer(initial_state="estimate"),
    ).round(1)
)

# %%
# **cross_val_predict**: simulations of the table by models that have not seen the
# experiment.

from sklearn.model_selection import cross_val_predict

simulated = cross_val_predict(model, X, y, cv=ExperimentSplit(2, **roles))
round(bft_score(y, simulated), 2)

# %%
# **n_jobs=2**: folds on two processes, with any of these tools.

print(cross_val_score(model, X, y, cv=ExperimentSplit(2, **roles), n_jobs=2).round(4))

# %%
# Choices
# -------
# **GridSearchCV** over all three steps, and a refit on all experiments. With
# **memory=**, a further degree identifies and restructures nothing anew, nor do folds
# that share operating points: 10 local models (five points, two horizons) and 20
# gray-box ones (two norms more), instead of 101 of each for eight combinations, three
# folds and the refit.
#
# Leave out *interior* points only (``interior=True``): the outermost ones would be
# extrapolated, which the model will not be used for, and which is worse the higher the
# degree. ``test_on="all"`` scores each model over the whole range; why is told in
# :ref:`guide_validation`.

from sklearn.model_selection import GridSearchCV

search = GridSearchCV(
    model,
    {
        "local__horizon": [6, 10],
        "restructurer__norm": ["hinf", "h2"],
        "interpolator__degree": [1, 2],
    },
    cv=ExperimentSplit(
        "all", hold_out="operating_point", interior=True, test_on="all", **roles
    ),
    scoring=make_bft_scorer(average="experiment"),
).fit(X, y)
pd.DataFrame(search.cv_results_).pivot_table(
    "mean_test_score",
    "param_interpolator__degree",
    ["param_restructurer__norm", "param_local__horizon"],
).round(2)

# %%
# The search is the best model, refitted: ``predict`` with it, look into it.

print(search.best_params_)
search.best_estimator_.parameters_.round(2)

# %%
# **learning_curve over experiments**: does a second experiment at every point pay?
# ``ExperimentSplit`` puts one of every point first, so that half the rows cover the
# range.

from sklearn.model_selection import learning_curve

sizes, _, test = learning_curve(
    search.best_estimator_,
    X,
    y,
    cv=ExperimentSplit("all", **roles),
    train_sizes=[0.56, 1.0],
    scoring=bft_scorer,
)
pd.Series(test.mean(axis=1).round(2), pd.Index(sizes, name="rows"), name="BFT (%)")

# %%
# Hardly: what is missing to 100 is the noise of the record that is predicted.
#
# Columns
# -------
# **permutation_importance by roles**: roles may be levels of the index, too. Then only
# inputs are columns, and only they are shuffled. (An input more needs a structure that
# has one more, or none: black boxes, the default.)

from sklearn.inspection import permutation_importance

wide = X.assign(idle=rng.choice([-1.0, 1.0], len(X)))
wide = wide.set_index(["experiment", "time", "kappa"])
black_box = model.set_params(restructurer=None, memory=None).fit(wide, y)
importance = permutation_importance(
    black_box, wide, y, scoring=bft_scorer, n_repeats=2, random_state=0
)
pd.Series(importance["importances_mean"], wide.columns, name="loss of BFT").round(1)

# %%
# **TransformedTargetRegressor**: outputs in other units, or scaled. Do not centre a
# signal that starts at rest: rest is zero.

from sklearn.compose import TransformedTargetRegressor
from sklearn.preprocessing import StandardScaler

scaled = TransformedTargetRegressor(
    black_box, transformer=StandardScaler(with_mean=False)
).fit(X, y)
round(bft_scorer(scaled, X, y), 2)

# %%
# A **ColumnTransformer** in front: here it scales the input. ``set_output`` keeps the
# names that the roles refer to.

from sklearn.compose import ColumnTransformer
from sklearn.pipeline import make_pipeline

front = ColumnTransformer(
    [("scale", StandardScaler(with_mean=False), ["u1"])],
    remainder="passthrough",
    verbose_feature_names_out=False,
).set_output(transform="pandas")
whole = make_pipeline(front, black_box).fit(X, y)
round(bft_scorer(whole, X, y), 2)

# %%
# Wrong splits
# ------------
# With a ``time`` column, shuffled rows are refused, with what to use instead; so are
# training sets that lack a part of an experiment, unless the local models have
# ``missing="split"``. Without one, the index of a table gets a warning, and nothing
# tells that rows of an array were shuffled.

from sklearn.model_selection import KFold

try:
    cross_val_score(model, X, y, cv=KFold(shuffle=True), error_score="raise")
except ValueError as error:
    print(error)

# %%
# Blocks of successive rows are in the order of time, and pass. A block that begins in
# the middle of an experiment is scored from rest all the same: the score is too low
# (sometimes far), and the library warns. Keep experiments whole, or estimate the
# initial state. What ``predict`` returns there is wrong in silence: it sees no output.

one = X["experiment"] == 0
local = SubspaceLTI(2, horizon=10, inputs="u1", feedthrough=False)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    torn = cross_val_score(local, X[one], y[one], cv=KFold(4), scoring=bft_scorer)
told = next(w.message for w in caught if "mid-motion" in str(w.message))
print(torn.round(1), told, sep="\n")
