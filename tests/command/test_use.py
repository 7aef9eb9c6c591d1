"""``lpvlearn predict`` and ``report``: what the model's file serves for."""

import io

import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn import StateSpace, save

from .conftest import run


@pytest.fixture(scope="module")
def model(folder):
    return folder / "spring" / "model.zip"


def test_predict_writes_the_simulation_alone(folder, model, tmp_path):
    status, out, error = run("predict", model, folder / "sweep.csv")
    assert status == 0
    assert "Simulation of sweep.csv, from rest" in error
    simulated = pd.read_csv(io.StringIO(out))
    table = pd.read_csv(folder / "sweep.csv")
    assert list(simulated) == ["run", "time", "position"]
    assert_allclose(simulated["position"], table["position"], atol=0.01)
    table.drop(columns="position").to_csv(tmp_path / "inputs.csv", index=False)
    place = tmp_path / "simulated.csv"
    arguments = ("predict", model, tmp_path / "inputs.csv", "--output", place)
    assert run(*arguments) == (0, "", "")
    pd.testing.assert_frame_equal(pd.read_csv(place), simulated)


def test_predict_from_the_middle_of_an_experiment(folder, model, tmp_path):
    table = pd.read_csv(folder / "sweep.csv").iloc[100:]
    path = tmp_path / "part.csv"
    table.to_csv(path, index=False)
    estimate = ("--initial-state", "estimate")
    status, out, _ = run("predict", model, path, *estimate)
    assert status == 0
    simulated = pd.read_csv(io.StringIO(out))
    assert_allclose(simulated["position"], table["position"], atol=0.01)
    error = run("predict", model, path)[2]
    assert (
        "Warnings of the simulation" in error and "- " in error
    )  # from rest it begins in mid-motion


@pytest.mark.slow
def test_report_tells_the_summary_and_writes_a_page(folder, model, tmp_path):
    status, out, error = run("report", model)
    assert (status, error) == (0, "")
    assert "kappa from 0 to 1.5" in out and "No warnings." in out
    page = tmp_path / "page.html"
    options = ("--table", folder / "sweep.csv", "--output", page)
    status, out, _ = run("report", model, *options)
    assert status == 0
    assert "Simulation of sweep.csv" in out
    assert "Measured and simulated" in page.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("timed", [False, True])
def test_several_files_are_experiments_to_a_model_of_one_file(folder, tmp_path, timed):
    table = pd.read_csv(folder / "runs.csv").query("kappa == 0.5")
    table = table.drop(columns=["run", "kappa", "extra"] + ["time"] * (not timed))
    table.to_csv(tmp_path / "one.csv", index=False)
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for path, n in zip(files, (200, 300), strict=True):  # from rest, both
        table[:n].to_csv(path, index=False)
    clock = ["--time", "time"] if timed else ["--sampling-time", 0.02]
    arguments = ["fit", tmp_path / "one.csv", "--inputs", "force", *clock, "--order", 2]
    arguments += ["--outputs", "position", "--output", tmp_path / "f", "--quiet"]
    assert run(*arguments, "--validation", *files) == (0, "", "")
    fit = pd.read_csv(tmp_path / "f" / "fit.csv")
    assert list(fit["experiment"]) == ["a", "b"]
    assert (fit["BFT"] > 99.9).all()
    model = tmp_path / "f" / "model.zip"
    status, out, error = run("predict", model, *files)
    simulated = pd.read_csv(io.StringIO(out))
    assert status == 0 and "Simulation of 2 tables" in error
    for path, found in simulated.groupby("experiment"):
        alone = pd.read_csv(
            io.StringIO(run("predict", model, tmp_path / f"{path}.csv")[1])
        )
        assert_allclose(found["position"], alone["position"])
    page = tmp_path / "page.html"
    status, out, _ = run("report", model, "--table", *files, "--output", page)
    assert status == 0 and " a " in out and " b " in out


def test_failures_tell_why(folder, model, tmp_path):
    other = tmp_path / "other.zip"
    save(StateSpace(-1, 1, 1), other)
    inputs = tmp_path / "inputs.csv"
    pd.read_csv(folder / "sweep.csv").drop(columns="kappa").to_csv(inputs, index=False)
    (tmp_path / "empty.csv").write_text("")
    for arguments, words in (
        (("report", other), "must hold a fitted LocalLPVPipeline"),
        (("report", tmp_path / "none.zip"), "there is no such file"),
        (("report", inputs), "must be a whole file that `save`"),
        (("predict", model, inputs), "inputs.csv lacks the column(s) 'kappa'"),
        (("predict", model, tmp_path / "empty.csv"), "empty.csv cannot be read"),
        (("predict", model, inputs, "--output", "a.mdf"), "a.mdf: the end of the name"),
    ):
        status, out, error = run(*arguments)
        assert (status, out) == (1, "")
        assert words in error
    inputs.write_text((folder / "sweep.csv").read_text().replace("position", "angle"))
    status, _, error = run("report", model, "--table", inputs)
    assert status == 1 and "lacks outputs to compare with: 'position'" in error
