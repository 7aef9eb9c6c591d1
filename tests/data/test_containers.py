"""Predictions in the container that `set_output` chooses."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import cross_val_score

from lpvlearn import SubspaceLTI, bft_scorer

from ..conftest import spring_tables

ROLES = {"inputs": "force", "experiment": "run", "time": "time"}


@pytest.fixture(scope="module")
def tables():
    X, y = spring_tables(n_samples=120)
    rows = X["run"] == X["run"].iloc[0]
    return X[rows].set_axis(np.arange(1000, 1000 + rows.sum())), y[rows]


@pytest.fixture(scope="module")
def model(tables):
    return SubspaceLTI(2, horizon=8, **ROLES).fit(tables[0], tables[1].to_numpy())


def test_arrays_are_the_default_and_none_changes_nothing(tables, model):
    plain = model.predict(tables[0])
    assert isinstance(plain, np.ndarray)
    tabled = clone(model).set_output(transform="pandas").set_output()
    tabled = clone(tabled).fit(tables[0], tables[1].to_numpy())
    found = tabled.predict(tables[0])
    assert list(found.index) == list(tables[0].index)
    assert list(found.columns) == ["y1"]
    np.testing.assert_array_equal(found, plain)
    unlabelled = clone(model).set_params(experiment=None, time=None, inputs=None)
    unlabelled.set_params(sampling_time=0.1).set_output(transform="pandas")
    u = tables[0][["force"]].to_numpy()
    rows = unlabelled.fit(u, tables[1].to_numpy()).predict(u.tolist()).index
    assert list(rows) == list(range(len(u)))
    back = tabled.set_output(transform="default").predict(tables[0])
    np.testing.assert_array_equal(back, plain)


def test_names_are_those_of_the_outputs_and_scores_do_not_change(tables, model):
    X, y = tables[0], tables[1].set_axis(tables[0].index)
    tabled = clone(model).set_output(transform="pandas").fit(X, y)
    assert tabled.lti_.input_names == ["force"]
    for found in (
        tabled.predict(X),
        tabled.predict_with_initial_state(X, y),
        tabled.predict_ahead(X, y),
    ):
        assert list(found) == ["position"]
    plain = SubspaceLTI(2, horizon=8, **ROLES).fit(X, y)
    assert tabled.score(X, y) == plain.score(X, y)
    assert bft_scorer(tabled, X, y) == bft_scorer(plain, X, y)
    assert np.isfinite(cross_val_score(tabled, X, y, cv=[(range(90), range(60))])).all()


def test_other_containers_are_refused(model):
    with pytest.raises(ValueError, match="`transform` must be"):
        clone(model).set_output(transform="xarray")


def test_polars(tables, model):
    polars = pytest.importorskip("polars")
    X = polars.DataFrame({name: tables[0][name].tolist() for name in tables[0]})
    found = clone(model).set_output(transform="polars").fit(X, tables[1]).predict(X)
    assert isinstance(found, polars.DataFrame) and found.columns == ["position"]


def test_tables_of_pyarrow_are_refused_by_name(tables, model):
    pa = pytest.importorskip("pyarrow")
    with pytest.raises(ValueError, match=r"a Table of pyarrow: use its to_pandas\(\)"):
        clone(model).fit(pa.Table.from_pandas(tables[0]), tables[1])
    with pytest.raises(ValueError, match="of pyarrow"):
        clone(model).fit(tables[0], pa.Table.from_pandas(tables[1]))
