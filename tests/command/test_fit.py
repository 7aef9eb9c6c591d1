"""``lpvlearn fit``: from a table to a folder that is whole, or not there."""

import io
import json

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn import load

from ..conftest import KAPPA, spring_tables, spring_truth
from .conftest import ROLES, run


def test_results_are_those_of_the_spring(folder):
    found = {path.name for path in (folder / "spring").iterdir()}
    assert found == {
        *("report.html", "report.txt", "model.zip", "figures"),
        *("points.csv", "parameters.csv", "fit.csv"),
    }
    points = pd.read_csv(folder / "spring" / "points.csv", index_col=0)
    assert_allclose(points.index, KAPPA)
    assert_allclose(points[["param_b", "param_c", "param_k"]], spring_truth(KAPPA))
    fit = pd.read_csv(folder / "spring" / "fit.csv")
    assert list(fit["experiment"]) == ["sweep"]
    assert fit["BFT"].iloc[0] > 99.9
    text = (folder / "spring" / "report.txt").read_text()
    assert "kappa from 0 to 1.5" in text
    assert "Simulation of sweep.csv, from rest" in text
    page = (folder / "spring" / "report.html").read_text()
    assert "position (m)" in page and "k (1/s2)" in page
    assert len(list((folder / "spring" / "figures").glob("*.svg"))) == 10
    assert [path for path in folder.iterdir() if path.name.startswith(".")] == []


@pytest.mark.slow
def test_one_record_of_levels_is_cut_at_them(folder, tmp_path):
    X, y = spring_tables(n_samples=300)
    log = X.join(y).drop(columns="run").assign(time=0.02 * np.arange(len(X)))
    log.iloc[295:305, log.columns.get_loc("kappa")] += 0.2  # on the way
    log.to_csv(tmp_path / "long.csv", index=False)
    roles = [x for x in ROLES if x not in ("--experiment", "run")]
    options = [*roles, "--levels", "--validation", folder / "sweep.csv"]
    target = tmp_path / "found"
    given = ["fit", tmp_path / "long.csv", *options, "--output", target]
    assert run(*given) == (0, "", "")
    points = pd.read_csv(target / "points.csv", index_col=0)
    assert_allclose(points.index, KAPPA)
    assert points["n_samples"].iloc[0] == 295
    nothing = [x for x in given[:-2] if x not in ("--scheduling", "kappa")]
    told = run(*nothing, "--output", tmp_path / "no")
    assert "--levels are those of --scheduling" in told[2]
    told = run(*given[:-2], "--levels", "-1", "--output", tmp_path / "no")
    assert "`--levels` must be a non-negative number" in told[2]


@pytest.mark.slow
def test_levels_of_the_column_that_tells_experiments_apart(tmp_path):
    X, y = spring_tables(n_samples=300)
    log = X.join(y).drop(columns=["run", "time"]).assign(experiment="bench")
    log.to_csv(tmp_path / "long.csv", index=False)
    options = ["--inputs", "force", "--outputs", "position", "--scheduling", "kappa"]
    options += ["--order", 2, "--sampling-time", 0.02, "--quiet", "--levels"]
    for column in ("kappa", "experiment"):
        target = tmp_path / column
        given = ["fit", tmp_path / "long.csv", *options, "--experiment", column]
        assert run(*given, "--output", target) == (0, "", "")
        points = pd.read_csv(target / "points.csv", index_col=0)
        assert_allclose(points.index, KAPPA)


@pytest.mark.slow
def test_a_row_of_units_tells_that_of_the_time(folder, tmp_path):
    table = pd.read_csv(folder / "runs.csv").query("kappa == 0.5")
    text = table[["time", "force", "position"]].to_csv(index=False)
    one, two = tmp_path / "one.csv", tmp_path / "two.csv"
    one.write_text(text)
    two.write_text(text.replace("\n", "\nms,N,-\n", 1))
    roles = ["--inputs", "force", "--outputs", "position", "--time", "time"]
    target = tmp_path / "f"
    status, out, _ = run("fit", two, *roles, "--order", 2, "--output", target)
    assert status == 0 and "samples at 2e-05 s" in out
    assert out.count("Times in column 'time' are taken as ms, as the table tells.") == 1
    assert load(target / "model.zip").units == {"force": "N"}
    status, out, error = run("predict", target / "model.zip", two)
    assert status == 0 and "are taken as ms" in error
    assert_allclose(pd.read_csv(io.StringIO(out))["time"], table["time"])
    status, _, error = run("predict", target / "model.zip", one)
    assert status == 1 and "read as seconds. Give --time-unit where" in error


def test_a_folder_is_not_written_over_unasked(folder):
    before = (folder / "spring" / "report.txt").stat().st_mtime_ns
    status, _, error = run("fit", folder / "runs.csv", *ROLES, "--output", folder)
    assert status == 1
    assert "the folder is not empty" in error and "--overwrite" in error
    assert (folder / "spring" / "report.txt").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--inputs", "torque"], "--inputs: the table has no column 'torque'"),
        (["--inputs", "force,position"], "'position' is in --outputs, too"),
        (["--time", "time,run"], "--time must name one column. Got 2."),
        (["--structure", "none.toml"], "none.toml: there is no such file."),
        (["--scheduling", "run"], "lpvlearn fit: "),
        (["--validation", "a.mdf"], "a.mdf: the end of the name must be one of .csv"),
        (["--degree", "2"], "--degree is that of --interpolation polynomial."),
        (["--validation", "none.csv"], "none.csv: there is no such file."),
    ],
)
def test_failures_tell_why_and_leave_nothing(folder, tmp_path, options, words):
    target = tmp_path / "deep" / "results"
    status, out, error = run(
        "fit", folder / "runs.csv", *ROLES, "--output", target, *options
    )
    assert (status, out) == (1, "")
    assert words in error
    assert not target.exists()
    assert not target.parent.exists() or list(target.parent.iterdir()) == []


def test_what_was_warned_of_is_told_where_the_fit_fails(folder, tmp_path):
    options = ["--outputs", "position", "--experiment", "run", "--scheduling", "kappa"]
    status, _, error = run(
        "fit", folder / "runs.csv", *options, "--output", tmp_path / "a"
    )
    assert status == 1  # the time is taken for an input, and so not known
    assert "Input column 'time' rises by the same 0.02" in error
    assert "`--sampling-time`" in error


@pytest.mark.parametrize("missing", ["--outputs", "--output"])
def test_usage_is_another_status(folder, missing):
    place = ROLES.index("--outputs")
    options = {"--outputs": ROLES[:place] + ROLES[place + 2 :], "--output": ROLES}
    output = [] if missing == "--output" else ["--output", "x"]
    status, _, error = run("fit", folder / "runs.csv", *options[missing], *output)
    assert status == 2
    assert f"required: {missing}" in error


@pytest.mark.slow
def test_json_gaps_other_csv_and_an_own_folder(folder, tmp_path):
    table = pd.read_csv(folder / "runs.csv")
    table.loc[100:105, "position"] = np.nan
    path = tmp_path / "runs.csv"
    table.to_csv(path, index=False, sep=";", decimal=",")
    form = tmp_path / "spring.json"
    form.write_text(json.dumps({"form": "observable_canonical", "order": 2}))
    target = tmp_path / "out"
    target.mkdir()
    (target / "notes.txt").write_text("mine")
    status, _, error = run(
        *("fit", path, *ROLES, "--structure", form, "--output", target),
        *("--overwrite", "--missing", "split"),
        *("--interpolation", "polynomial", "--degree", "2"),
    )
    assert (status, error) == (0, "")
    assert (target / "notes.txt").read_text() == "mine"
    points = pd.read_csv(target / "points.csv", index_col=0)
    truth = spring_truth(points.index)
    assert_allclose(points["param_a2_1"], -truth[:, 2], rtol=1e-6)
    assert points["n_samples"].tolist() == [294, 300, 300, 300]
    arguments = ["fit", path, *ROLES, "--output", tmp_path / "b"]
    status, _, error = run(*arguments)  # separator and decimal mark are found
    assert status == 1 and "identify with --missing split, which cuts" in error
    status, _, error = run(*arguments, "--separator", "|")
    assert status == 1 and "tell --separator" in error


@pytest.mark.parametrize("end", ["parquet", "xlsx"])
def test_other_kinds_of_tables(folder, tmp_path, end, monkeypatch):
    package = {"parquet": "pyarrow", "xlsx": "openpyxl"}[end]
    path = tmp_path / f"sweep.{end}"
    with monkeypatch.context() as patch:
        patch.setitem(__import__("sys").modules, package, None)
        status, _, error = run("predict", folder / "spring" / "model.zip", path)
        assert status == 1
        assert f"pip install {package}" in error
    pytest.importorskip(package)
    table = pd.read_csv(folder / "sweep.csv")
    getattr(table, {"parquet": "to_parquet", "xlsx": "to_excel"}[end])(
        path, index=False
    )
    out = tmp_path / f"out.{end}"
    status, _, error = run(
        "predict", folder / "spring" / "model.zip", path, "--output", out
    )
    assert status == 0
    read = {"parquet": pd.read_parquet, "xlsx": pd.read_excel}[end]
    assert_allclose(read(out)["position"], table["position"], atol=0.01)
    assert np.isfinite(read(out)["time"]).all()
