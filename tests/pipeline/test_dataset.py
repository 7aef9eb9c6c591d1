"""Fits of data sets that are read by experiment: as of the whole table."""

import sys

import numpy as np
import pandas as pd
import pytest

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, PolynomialLPV, SubspaceLTI

from ..conftest import ROLES, spring_structure, spring_tables

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def tables():
    return spring_tables(noise=0.01, n_samples=200, n_repeats=2, kappas=(0.0, 0.7, 1.5))


def chain(**options):
    local = SubspaceLTI(2, horizon=6)
    restructurer = GrayBoxRestructurer(spring_structure(), norm="h2", n_starts=2)
    options = {"restructurer": restructurer, **ROLES, **options}
    return LocalLPVPipeline(local, interpolator=PolynomialLPV(1), **options)


def assert_same_fit(one, other):
    np.testing.assert_array_equal(
        one.lpv_.coefficients().C, other.lpv_.coefficients().C
    )
    pd.testing.assert_frame_equal(one.parameters_, other.parameters_)
    pd.testing.assert_frame_equal(one.report_, other.report_)
    assert one.output_names_ == other.output_names_
    assert [*one.feature_names_in_] == [*other.feature_names_in_]


@pytest.mark.slow
@pytest.mark.parametrize("combine", ["pool", "average"])
def test_a_file_and_a_table_give_one_fit(tables, tmp_path, combine):
    X, y = tables
    X.join(y).to_parquet(tmp_path / "all.parquet", row_group_size=170)
    whole = chain(combine=combine).fit(X, y)
    found = chain(combine=combine).fit_dataset(tmp_path / "all.parquet", ["position"])
    assert_same_fit(found, whole)
    np.testing.assert_array_equal(found.predict(X), whole.predict(X))


@pytest.mark.slow
def test_a_folder_of_partitions_is_read_by_its_names(tables, tmp_path):
    X, y = tables
    table = X.join(y)
    table["run"] = table["run"].astype("category").cat.codes
    table.to_parquet(tmp_path, partition_cols=["run"])
    whole = chain().fit(table[X.columns], table["position"])
    found = chain(n_jobs=2).fit_dataset(str(tmp_path), "position")
    np.testing.assert_allclose(found.parameters_, whole.parameters_, rtol=1e-9)
    assert found.predict(table[X.columns]).ndim == 1


@pytest.mark.slow
def test_a_dataset_of_arrow_is_one(tables):
    pa, arrow = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.dataset")
    X, y = tables
    table = pa.Table.from_pandas(X.join(y), preserve_index=False)
    found = chain().fit_dataset(arrow.dataset(table), ["position"])
    assert_same_fit(found, chain().fit(X, y))


def written(tmp_path, tables, change):
    path = tmp_path / "t.parquet"
    change(tables[0].join(tables[1])).to_parquet(path)
    return path


@pytest.mark.parametrize(
    "change, outputs, told",
    [
        (lambda t: t.iloc[::-1], "position", "must increase|backwards|order of time"),
        (
            lambda t: pd.concat([t.iloc[:100], t.iloc[200:], t.iloc[100:200]]),
            "position",
            "one after another. Got more of 'p0r0' in column 'run'",
        ),
        (
            lambda t: t.drop(columns="run"),
            "position",
            "`experiment` must name a column",
        ),
        (lambda t: t, "speed", "`outputs` must name columns .*'position'. Got 'speed'"),
        (lambda t: t, [], "`outputs` must name columns"),
        (lambda t: t.iloc[:0], "position", "at least one row"),
        (lambda t: t.assign(force=np.nan), "position", "NaN|nan|missing"),
        (
            lambda t: t.assign(time=t["time"] * np.where(t["run"] == "p1r0", 2, 1)),
            "position",
            "step",
        ),
    ],
)
def test_data_sets_that_cannot_be_fitted_are_told(
    tables, tmp_path, change, outputs, told
):
    path = written(tmp_path, tables, change)
    with pytest.raises(ValueError, match=told):
        chain().fit_dataset(path, outputs)


def test_what_is_no_data_set_is_told(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="`dataset` must be a pyarrow.*Got DataFrame"):
        chain().fit_dataset(pd.DataFrame(), "y")
    with pytest.raises(FileNotFoundError):
        chain().fit_dataset(tmp_path / "none.parquet", "y")
    (tmp_path / "no.parquet").write_text("no table")
    with pytest.raises(ValueError, match="`dataset` must be the path"):
        chain().fit_dataset(tmp_path / "no.parquet", "y")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"pip install 'lpvlearn\[tables\]'"):
        chain().fit_dataset(tmp_path, "y")
