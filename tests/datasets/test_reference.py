"""The stored files are what the generator makes, and are found."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline
from lpvlearn.datasets import (
    load_flexible_arm,
    load_varying_spring,
    make_flexible_arm,
)
from lpvlearn.datasets import reference as reference_module


@pytest.fixture(scope="module")
def reference():
    return load_flexible_arm()


@pytest.mark.slow
def test_files_hold_what_the_generator_makes(reference):
    made = make_flexible_arm(random_state=reference_module.REFERENCE_SEED)
    assert set(made) == set(reference)
    for name in (name for pair in reference_module.TABLES.values() for name in pair):
        assert list(made[name].columns) == list(reference[name].columns)
        # 7 digits
        np.testing.assert_allclose(
            reference[name], made[name], rtol=1e-6, atol=1e-6, err_msg=name
        )
    np.testing.assert_array_equal(made.theta2, reference.theta2)


@pytest.mark.slow
def test_writing_twice_gives_the_same_bytes(tmp_path, monkeypatch, reference):
    monkeypatch.setattr(reference_module, "make_flexible_arm", lambda **_: reference)
    reference_module.write_reference(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        stored = reference_module.data_folder() / path.name
        # Other versions of zlib may compress the same text differently.
        assert gzip.decompress(path.read_bytes()) == gzip.decompress(
            stored.read_bytes()
        )


def test_data_card_names_every_file(reference):
    for name in reference_module.TABLES:
        assert name in reference.DESCR


def test_the_stored_spring_is_identified_as_what_it_is():
    data = load_varying_spring()
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(data.structure),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(data.X, data.y)
    assert pipeline.sampling_time_ == pytest.approx(data.sampling_time)
    names = list(pipeline.parameters_)
    error = pipeline.parameters_ - data.true_parameters[names].to_numpy()
    assert (error.abs() < 4 * pipeline.parameters_std_).all(axis=None)
    assert "varying_spring.csv" in data.DESCR


def test_missing_files_are_explained(monkeypatch, tmp_path):
    monkeypatch.setattr(
        reference_module, "__file__", str(tmp_path / "a" / "b" / "c.py")
    )
    with pytest.raises(FileNotFoundError, match="reinstall lpvlearn"):
        load_flexible_arm()


def test_wheel_folder_comes_first(monkeypatch, tmp_path):
    package = tmp_path / "lpvlearn" / "datasets"
    (package / "data").mkdir(parents=True)
    (package / "data" / next(iter(reference_module.TABLES))).touch()
    monkeypatch.setattr(reference_module, "__file__", str(package / "reference.py"))
    assert reference_module.data_folder() == Path(package / "data").resolve()
