r"""
.. _guide_logs:

Tables as loggers write them
============================

Clocks jitter, rows are lost, sensors drop out, one file has dates and the next
milliseconds. What the library takes as it is, what it asks you to decide, and what it
refuses.
"""

# %%
# A record as it should be: a mass on a spring, a force that a computer sets every 20
# ms, the position that it reads then.

import numpy as np
import pandas as pd

from lpvlearn import SubspaceLTI, bft_scorer, fit_report, make_bft_scorer, resample
from lpvlearn.datasets import load_varying_spring, prbs

rng = np.random.default_rng(0)
STEP = 0.02
spring = load_varying_spring().structure.model({"b": 30.0, "c": 1.2, "k": 40.0})


def log(ticks):
    """A record whose samples are taken at these milliseconds."""
    force = prbs(len(ticks), clock=5, random_state=0)[:, 0]
    held = force[np.searchsorted(ticks, np.arange(ticks[-1] + 1), "right") - 1]
    position = spring.simulate(held, sampling_time=1e-3)[ticks, 0]
    noise = 0.01 * position.std() * rng.standard_normal(len(ticks))
    table = pd.DataFrame({"time": 1e-3 * ticks, "force": force})
    return table, pd.Series(position + noise, name="position")


def pole(model):
    """Of the identified model; the true one is -0.6 + 6.2960j."""
    return complex(model.lti_.to_continuous().poles()[1].round(4))


X, y = log(20 * np.arange(1500))
model = SubspaceLTI(2, horizon=10, feedthrough=False, time="time").fit(X, y)
pole(model)

# %%
# Jitter
# ------
# Stamps that deviate from an even grid by up to 1 % of the step are taken as even; so
# are stamps that are rounded to a few decimals. ``time_tol`` sets that share, of
# :class:`~lpvlearn.SubspaceLTI` and of :class:`~lpvlearn.LocalLPVPipeline`. How far
# they deviate stands in ``time_jitter_``:

shaken = X.assign(time=X["time"] + STEP * 0.005 * rng.uniform(-1, 1, len(X)))
round(model.fit(shaken, y).time_jitter_, 4)

# %%
# Worse clocks are refused, with the place:

ticks = np.cumsum(20 + rng.integers(-4, 5, 1500))
X_loop, y_loop = log(ticks - ticks[0])
try:
    model.fit(X_loop, y_loop)
except ValueError as error:
    print(error)

# %%
# :func:`~lpvlearn.resample` puts such a record on an even grid, every experiment on its
# own (``experiment=``). Outputs are interpolated, by straight lines or
# ``method="cubic"``. An input that is *held* between samples, as the force here, is a
# staircase, and no line between its samples was ever there: it takes its mean over
# every new interval, which pushes the mass as far. Columns that often keep their value
# are recognised; ``hold=["force"]`` names them, ``hold=[]`` says that there are none.

held = resample(X_loop, y_loop, time="time")
smooth = resample(X_loop, y_loop, time="time", hold=[])
pd.Series(
    {
        "held, recognised": bft_scorer(model.fit(*held), *held),
        "taken for a smooth signal": bft_scorer(model.fit(*smooth), *smooth),
    },
    name="BFT (%)",
).round(1)

# %%
# A grid that is coarser than the record (``sampling_time=``) is reached through a
# filter without delay, the same for all signals, so that fast noise does not come back
# as slow noise, and the model stays what it is. Resample where you must, not always:
# interpolation correlates the noise.
#
# Lost rows, missing values
# -------------------------
# A logger that loses rows leaves holes in the ``time`` column; a sensor that drops out
# leaves NaN. A record with either is not one record, and is refused until you say that
# it may be cut: ``missing="split"`` ends an experiment before a gap and starts another
# after it, with an initial state of its own.

lost = rng.random(len(X)) < 0.01
X_lost, y_lost = X[~lost], y[~lost].mask(rng.random((~lost).sum()) < 0.01)
try:
    model.fit(X_lost, y_lost)
except ValueError as error:
    print(error)

# %%
split = SubspaceLTI(2, horizon=10, feedthrough=False, time="time", missing="split").fit(
    X_lost, y_lost
)
pole(split)

# %%
# Every piece has an initial state to be found, and where outputs are missing often, the
# pieces are too short to tell anything. ``missing="estimate"`` does not cut there. It
# estimates the outputs by the model and its noise, and the model by what is known of
# them, in turn, until neither moves: the algorithm of *expectation and maximisation*.
# Inputs and rows that are missing end an experiment as before, for nobody knows where
# the system is after them. Here a third of the outputs is not there:

often = y.mask(rng.random(len(y)) < 0.3)
estimated_outputs = SubspaceLTI(
    2, horizon=10, feedthrough=False, time="time", missing="estimate"
).fit(X, often)
pole(estimated_outputs)

# %%
# In a pipeline both are options of the local models:
# ``LocalLPVPipeline(SubspaceLTI(missing="estimate"), ...)``. They are the remedy for
# *spikes* as well, which a fit tells of where they make much of its errors: write NaN
# in place of what the sensor got wrong. Resampling bridges gaps of up
# to ``max_gap`` steps, and writes NaN into longer ones. After a gap in which the plant
# was stopped, or something else moved it, "split" is right: what the model expects
# takes no part in it.
#
# Scores, reports and pictures leave out what was not measured, and say how much that
# is:

fit_report(model.fit(X, y), X, y.mask(rng.random(len(y)) < 0.1)).round(2)

# %%
# Missing *outputs* do not disturb a simulation. Missing *inputs* and rows do: nobody
# knows where the system is after them. A simulation from rest is refused there; with an
# estimated initial state it begins anew after every gap:

estimated = make_bft_scorer(initial_state="estimate")
round(estimated(split, X_lost, y_lost), 2)

# %%
# A prediction that is not finite where there is a measurement is an error, not a
# missing sample.
#
# Seconds, milliseconds, dates
# ----------------------------
# Numbers in the ``time`` column are *seconds*. Dates (with or without a time zone, in
# any resolution) and time differences tell their unit; a model that was fitted on one
# predicts on the others:

dates = pd.Timestamp("2024-05-01 12:00", tz="Europe/Paris") + pd.to_timedelta(
    X["time"], unit="s"
)
bool(np.allclose(model.predict(X.assign(time=dates)), model.predict(X)))

# %%
# That a column of numbers holds milliseconds cannot be seen when it is the first one.
# Where the step of ``predict`` is not that of ``fit``, it can. (A discrete-time model
# has one step. The pipeline's LPV model is in continuous time and follows any; it
# refuses factors of 1000.)

try:
    model.predict(X.assign(time=1000 * X["time"]))
except ValueError as error:
    print(error)

# %%
# Columns and labels
# ------------------
# After ``fit``, columns are found by name, in any order; others may stand beside them.
# Needed are inputs, the scheduling variables of a pipeline and the column that tells
# the experiments apart. ``time`` and ``operating_point`` may be left out: without times
# a table has the step of the fit.

bool(np.allclose(model.predict(X[["force"]].assign(note="new")), model.predict(X)))

# %%
# Outputs with the row labels of ``X`` in another order are put into that of ``X``, with
# a warning; labels that agree in part only, rows 0 to 99 beside rows 50 to 149, are an
# error. Without common labels, rows belong together as they stand.

import warnings

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    score = model.score(X, y.sample(frac=1.0, random_state=0))
print(round(score, 4), caught[0].message, sep="\n")

# %%
# Starts in mid-motion
# --------------------
# ``predict`` and ``score`` simulate from rest. scikit-learn's default splits cut a
# record into blocks, of which only the first starts there. The scores below are too
# low for their models, and a warning says so: it estimates the initial state from the
# outputs, and looks whether that explains much more than chance would. (Another one,
# by the index, says that the training of the inner folds has a hole. With the ``time``
# column they would be refused.)

from sklearn.model_selection import cross_val_score

alone = SubspaceLTI(2, horizon=10, feedthrough=False, sampling_time=STEP)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from_rest = cross_val_score(alone, X[["force"]][:500], y[:500])
print(next(w.message for w in caught if "mid-motion" in str(w.message)))

# %%
# The remedy is another split (:class:`~lpvlearn.ExperimentSplit`), or, as long as there
# is only one record, another scorer:

pd.DataFrame(
    {
        "from rest (R2)": from_rest,
        "initial state estimated (BFT)": cross_val_score(
            alone, X[["force"]][:500], y[:500], scoring=estimated
        ),
    }
).round(3)
