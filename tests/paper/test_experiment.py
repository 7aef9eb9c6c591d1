"""``python -m lpvlearn`` at reduced size: what it writes, and what it must show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lpvlearn.__main__ import main
from lpvlearn.paper.tables import TABLE_1, TABLE_2

# One run of the command takes more than ten seconds.
pytestmark = pytest.mark.slow

COLUMNS = {
    "table1": ["theta2", "metric", "output", "ours", "paper"],
    "table1_other": ["theta2", "metric", "output", "ours", "paper"],
    "table2": ["theta2", "relative_error", "floor", "paper"],
    "table3": ["model", "degree", "matrix", "ours", "paper"],
    "table4": ["model", "output", "metric", "ours", "paper"],
    "momentum": ["sweep", "output", "metric", "ours"],
    "timing": ["step", "seconds"],
}
ANGLES = np.arange(1, 8) * np.pi / 8


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory that one run of the command has filled."""
    directory = tmp_path_factory.mktemp("paper") / "results"
    options = f"--realizations 2 --seed 0 --jobs 1 --output {directory}"
    assert main(options.split()) == 0
    return directory


def read(results: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(results / f"{name}.csv")


@pytest.mark.parametrize("name", COLUMNS)
def test_tables_have_the_documented_columns(results: Path, name: str) -> None:
    assert read(results, name).columns.tolist() == COLUMNS[name]


def test_directory_holds_the_tables_and_figures_and_nothing_else(results: Path) -> None:
    figures = [f"figure{number:02d}.png" for number in range(2, 11)]
    tables = [f"{name}.csv" for name in COLUMNS]
    assert sorted(path.name for path in results.iterdir()) == sorted(figures + tables)


@pytest.mark.parametrize("number", range(2, 11))
def test_figures_are_png_pictures_with_something_drawn(
    results: Path, number: int
) -> None:
    from matplotlib.image import imread

    pixels = imread(results / f"figure{number:02d}.png", format="png")
    assert pixels.shape[1] > 800
    assert pixels[..., :3].std() > 0.02


@pytest.mark.parametrize("name", ["table1", "table1_other"])
def test_local_models_fit_new_data_better_than_published(
    results: Path, name: str
) -> None:
    table = read(results, name)
    np.testing.assert_allclose(table["theta2"].unique(), ANGLES)
    bft, vaf = (table[table["metric"] == m]["ours"] for m in ("BFT", "VAF"))
    assert bft.min() >= 98.0
    assert vaf.min() >= 99.95


def test_published_figures_stand_beside_ours_at_their_angle(results: Path) -> None:
    table = read(results, "table1").set_index(["metric", "output"])
    for key, published_row in TABLE_1.items():
        np.testing.assert_allclose(table.loc[key, "paper"], published_row)
    np.testing.assert_allclose(read(results, "table2")["paper"], TABLE_2)


def test_restructuring_ends_at_its_floor_or_below_the_published_worst(
    results: Path,
) -> None:
    table = read(results, "table2")
    error, floor = table["relative_error"], table["floor"]
    assert ((error <= 4e-3) | (error <= 1.02 * floor)).all()
    # No error of a model with the structure's gain can be below the floor.
    assert (error >= floor * (1 - 1e-9)).all()


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("matrix", ["A", "B"])
def test_restructured_matrices_interpolate_as_well_as_the_analytic_ones(
    results: Path, matrix: str, degree: int
) -> None:
    fit = read(results, "table3").set_index(["matrix", "degree", "model"])["ours"]
    ours, analytic = (
        fit[matrix, degree, model] for model in ("restructured", "analytic")
    )
    assert abs(ours - analytic) < 1.0


def test_lpv_model_follows_the_sweep_as_well_as_the_analytic_one(
    results: Path,
) -> None:
    table = read(results, "table4")
    bft = table[table["metric"] == "BFT"].set_index(["output", "model"])["ours"]
    for output in ("y1", "y2"):
        assert bft[output, "restructured"] > bft[output, "analytic"] - 1.5
        assert bft[output, "balanced"] < bft[output, "restructured"] - 10.0


def test_momenta_and_their_form_follow_sweeps_both_ways(results: Path) -> None:
    table = read(results, "momentum")
    assert table["sweep"].unique().tolist() == ["up", "down"]
    bft = table[table["metric"] == "BFT"]["ours"]
    assert len(bft) == 4
    assert bft.min() > 96.0


def test_total_time_is_the_sum_of_the_steps(results: Path) -> None:
    seconds = read(results, "timing").set_index("step")["seconds"]
    assert seconds["total"] == pytest.approx(seconds.drop("total").sum())
    assert {"local models", "restructuring", "figures"} <= set(seconds.index)
