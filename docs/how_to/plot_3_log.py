r"""
.. _how_to_log:

Prepare a log
=============

From a file as a data logger leaves it to a table that identifies: dates, units, a drive
that repeats itself, holes. Each step is a line; why it is needed stands in
:ref:`guide_logs`.

* **One row, one instant; one column, one signal.** A column says which record a row
  belongs to (``experiment``).
* **Seconds.** Dates are taken as they are; milliseconds are divided by 1000.
* **SI units**, or any that you keep: parameters come out in them.
* **Outputs apart from inputs.** What the system *got* is an input, what it *did* is an
  output. A set point is an input only if the controller belongs to the model.
* **No filter.** Smoothing changes the model. If there must be one, the same for
  all signals: that of ``resample``.
* **No offsets taken out by hand.** They are found (:ref:`guide_points_of_work`).
"""

# %%
# A heater at three speeds of its fan, written on three days by a logger set to German:
# decimal commas, local time, degrees Celsius, per cent, a missed row, a sensor that
# dropped out.

import io

import numpy as np
import pandas as pd

from lpvlearn import StateSpace
from lpvlearn.datasets import prbs

rng = np.random.default_rng(0)
files = []
for day, speed in enumerate([20.0, 40.0, 60.0]):  # per cent
    rate = 0.01 + 0.02 * speed / 100  # 1/s
    heater = StateSpace([[-rate]], [[0.004]], [[1.0]])
    power = 500.0 + 300.0 * prbs(900, clock=20, random_state=day)[:, 0]  # W
    kelvin = heater.simulate(power, sampling_time=2.0, initial_state=[2 / rate])[:, 0]
    start = pd.Timestamp("2024-03-04 08:00") + pd.Timedelta(days=day)
    table = pd.DataFrame(
        {
            "Zeit": start + pd.to_timedelta(2.0 * np.arange(900), unit="s"),
            "Leistung": power,
            "Drehzahl": speed + 0.1 * rng.standard_normal(900),
            "Temperatur": 21.0 + kelvin + 0.3 * rng.standard_normal(900),
        }
    )
    table.loc[400, "Temperatur"] = np.nan
    table = table.drop(index=[250])
    files.append(table.to_csv(sep=";", decimal=",", index=False))
print(files[0][:150])

# %%
# Read, join, rename:

records = {
    f"day {k}": pd.read_csv(
        io.StringIO(text), sep=";", decimal=",", parse_dates=["Zeit"]
    )
    for k, text in enumerate(files)
}
log = pd.concat(records, names=["record"]).reset_index("record").reset_index(drop=True)
log = log.rename(
    columns={
        "Zeit": "time",
        "Leistung": "power",
        "Drehzahl": "speed",
        "Temperatur": "temperature",
    }
)
log["speed"] /= 100  # a share
log.groupby("record").head(1)

# %%
# Look at it before any model does: steps of time, ranges, missing values.

step = log.groupby("record")["time"].diff().dt.total_seconds()
print(step.value_counts())
log.describe().loc[["count", "min", "max"]].round(2)

# %%
# One row is missing in every record, and one temperature. ``missing="split"`` cuts
# there. The speed is held as well as a fan holds it; its mean over a record is the
# operating point, and how far it moves tells which means are one point. The
# temperature stands about that of the room. The local models look for such constants
# (``offset="auto"``) and find them here.

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    SubspaceLTI,
)

first_order = GrayBoxStructure.from_template(A=[["-rate"]], B=[["gain"]], C=[[1]])
heater = LocalLPVPipeline(
    SubspaceLTI(1, feedthrough=False, missing="split"),
    GrayBoxRestructurer(first_order),
    scheduling="speed",
    experiment="record",
    time="time",
).fit(log[["record", "time", "power", "speed"]], log["temperature"])
heater.parameters_.round(5)

# %%
# The truth: a gain of 0.004 K/J, and rates of 0.014, 0.018 and 0.022 1/s. The LPV model
# stands about an offset of power and temperature. Where does the temperature go without
# any power? To the 21 degrees of the room:

lpv = heater.lpv_
speeds = [0.2, 0.4, 0.6]
room = [
    lpv.output_offset([speed])
    - (lpv.at(speed).dc_gain() @ np.ravel(lpv.input_offset([speed])))
    for speed in speeds
]
pd.Series(np.ravel(room), index=pd.Index(speeds, name="speed")).round(1)

# %%
# One record of several levels
# ----------------------------
# Often there is one long record, in which the scheduling variable was held at one level
# after another. :func:`~lpvlearn.split_levels` numbers the stretches in which it is
# held, each of which becomes an experiment; what is between has the number -1, and is
# left out, or kept as a test of the model. Here the three records in one:

from lpvlearn import split_levels

long = log.drop(columns="record")
long["record"] = split_levels(long, "speed", tol=0.02)
held = long[long["record"] >= 0]
held.groupby("record")["speed"].agg(["mean", "size"]).round(3)

# %%
# ``tol`` is how far the variable may range within a stretch, a few times its noise.
# At the command line it is ``lpvlearn fit --levels``.
