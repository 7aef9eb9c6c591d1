"""Where a search begins: models of a table as if it stood still, or through points."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    GrayBoxStructure,
    OutputErrorLPV,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
    bft_score,
)

from ..conftest import (
    ROLES,
    spring_lpv,
    spring_structure,
    spring_sweep,
    spring_tables,
    spring_truth,
)
from .conftest import FINE, sweeps


@pytest.mark.slow
@pytest.mark.parametrize("form", [None, RationalLPV(2, 1), SplineLPV("cubic")])
def test_from_a_time_invariant_model_of_the_table(form):
    X, y = sweeps(noise=0.0, n_samples=400)
    model = OutputErrorLPV(spring_structure(), interpolator=form, rate=False, **ROLES)
    model.fit(X, y)
    assert (model.report_["start_BFT"] < 60).all()
    assert (model.report_["BFT"] > 99.5).all()
    if form is None:
        np.testing.assert_allclose(
            model.lpv_.parameters(FINE), spring_truth(FINE), rtol=1e-4
        )


@pytest.mark.slow
def test_from_the_points_at_which_experiments_stay():
    """Their parameters tell the form, too: 1 / rope is no polynomial."""
    rope = GrayBoxStructure.from_template(
        [[0, 1], ["-w2", "-c"]], [[0], ["-b"]], [[1, 0]]
    )
    rng = np.random.default_rng(0)
    steady = [np.full(500, length) for length in (0.5, 0.9, 1.5, 2.2, 3.0)]
    t = 0.05 * np.arange(500)
    moving = [1.75 + 1.2 * np.sin(w * t + w) for w in (0.3, 0.4, 0.35)]
    tables = []
    for run, lengths in enumerate([*steady, *moving]):
        u, x, y = np.repeat(rng.choice([-1.0, 1.0], 125), 4), np.zeros(2), []
        for force, length in zip(u, lengths, strict=True):
            y.append(x[0])
            now = rope.model([1.0 / length, 0.15, 9.81 / length]).to_discrete(0.05)
            x = now.A @ x + now.B[:, 0] * force
        y = y + 0.02 * np.std(y) * rng.standard_normal(500)
        columns = {"force": u, "kappa": lengths, "run": run, "time": t, "angle": y}
        tables.append(pd.DataFrame(columns))
    fresh, table = tables.pop(), pd.concat(tables, ignore_index=True)
    model = OutputErrorLPV(rope, **ROLES).fit(
        table.drop(columns="angle"), table[["angle"]]
    )
    fit = bft_score(fresh[["angle"]], model.predict(fresh.drop(columns="angle")))
    assert fit > 97.0


@pytest.mark.slow
def test_without_a_structure_matrices_are_affine_in_the_scheduling():
    truth = spring_lpv()
    X, _ = sweeps()
    bounds = np.array([[0.0], [1.5]])
    line = PolynomialLPV(1).fit(bounds, [[30, 1.2, 40], [30, 1.2, 80]])
    truth = replace(truth, interpolator=line)
    y = np.concatenate(
        [
            truth.simulate(run[["force"]], run["kappa"], 0.02)
            for _, run in X.groupby("run")
        ]
    )
    local = SubspaceLTI(2, feedthrough=False, stability="enforce")
    model = OutputErrorLPV(rate=False, local=local, **ROLES).fit(X, y)
    assert model.lpv_.interpolator.degree == 1
    assert (model.report_["BFT"] > 99).all()
    assert model.predict(X).shape == y.shape


@pytest.mark.slow
def test_without_scheduling_it_is_an_output_error_model():
    X, y = spring_tables(noise=0.05, kappas=[1.0], n_samples=300)
    roles = {"inputs": "force", "time": "time"}
    model = OutputErrorLPV(spring_structure(), **roles).fit(X, y)
    np.testing.assert_allclose(
        model.lpv_.parameters([0.0])[0], spring_truth(1.0)[0], rtol=0.02
    )


@pytest.mark.slow
def test_states_that_move_are_no_more_states():
    """Of a time-invariant model they are, and slow ones would stand for constants."""
    bounds = np.array([[0.0], [1.5]])
    line = PolynomialLPV(1).fit(bounds, [[30, 1.2, 40], [30, 1.2, 160]])
    truth = replace(spring_lpv(), interpolator=line)
    X, fresh = sweeps(n_samples=500)[0], spring_sweep(500, seed=77)[0]
    exact, new = (
        np.concatenate(
            [
                truth.simulate(r[["force"]], r["kappa"], 0.02)
                for _, r in x.groupby("run")
            ]
        )
        for x in (X, fresh.assign(run="new"))
    )
    rng, size = np.random.default_rng(4), exact.std()
    for noise, level in ((0.05, 5.0), (0.0, 0.0)):
        y = exact + size * (noise * rng.standard_normal(exact.shape) + level)
        model = OutputErrorLPV(rate=False, **ROLES).fit(X, y)
        assert model.lpv_.order == 2
        assert bft_score(new + level * size, model.predict(fresh)) > 96.0
