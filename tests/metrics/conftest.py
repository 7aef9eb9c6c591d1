"""Signals and an estimator that several rooms are tested with."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin

from lpvlearn.data.experiments import read_experiments

RNG = np.random.default_rng(0)
IN_MOTION = pytest.mark.filterwarnings("ignore:The scored table starts in mid-motion")
Y_TRUE = RNG.normal(size=(50, 2))
Y_PRED = Y_TRUE + RNG.normal(scale=[0.1, 0.4], size=(50, 2)) + [0.2, 0.0]


class GainFromRest(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """y = gain u plus a state that the simulation from rest misses."""

    def __init__(self, gain=1.0, experiment=None, scheduling=None, time=None):
        self.gain = gain
        self.experiment = experiment
        self.scheduling = scheduling
        self.time = time

    def _read(self, X, y=None, reset=False):
        return read_experiments(
            self,
            X,
            y,
            inputs=["u"],
            experiment=self.experiment,
            scheduling=self.scheduling,
            time=self.time,
            reset=reset,
        )

    def fit(self, X, y):
        self._read(X, y, reset=True)
        return self

    def split_experiments(self, X):
        return [run.rows for run in self._read(X)]

    def predict(self, X):
        y = np.empty((len(X), 2))
        for run in self._read(X):
            y[run.rows] = self.gain * run.inputs * [1.0, 2.0]
        return y

    def predict_with_initial_state(self, X, y):
        simulated = self.predict(X)
        for rows in self.split_experiments(X):
            simulated[rows] += 0.9 ** np.arange(len(rows))[:, None]
        return simulated


@pytest.fixture
def data():
    rng = np.random.default_rng(1)
    X = pd.DataFrame({"u": rng.normal(size=120)})
    X["run"] = np.repeat(["a", "b", "c"], 40)
    X["kappa"] = np.repeat([0.25, 0.5, 0.75], 40)
    model = GainFromRest(experiment="run", scheduling="kappa").fit(
        X, X["u"].rename("y")
    )
    true = model.predict_with_initial_state(X, None)
    return model, X, pd.DataFrame(true, columns=["vx", "vy"])
