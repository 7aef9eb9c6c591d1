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
