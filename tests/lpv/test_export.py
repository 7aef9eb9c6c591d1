"""Frozen models for other programs: python-control and MATLAB."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import loadmat

from lpvlearn import PolynomialLPV, StateSpace
from lpvlearn.exceptions import ExtrapolationWarning

from ..conftest import spring_lpv
from .conftest import assert_same_matrices, lpv_model


def with_offsets(lpv):
    kappa = np.array([[0.0], [1.0]])
    form = PolynomialLPV(1).fit(kappa, np.outer([1.0, 3.0], [1, 2, 3, 4]))
    return replace(lpv, offsets=form)


def test_a_grid_has_the_frozen_models():
    lpv = replace(spring_lpv(), scheduling_names=["kappa"], input_delay=0.1)
    points = [0.0, 0.3, 1.5]
    for given in (points, {"kappa": points}, pd.DataFrame({"kappa": points})):
        for k, model in zip(points, lpv.grid(given), strict=True):
            assert_same_matrices(model, lpv.at(k), 0.0)
            assert_array_equal(model.input_delay, [0.1])
    with pytest.raises(ValueError, match="at least one row"):
        lpv.grid(np.empty((0, 1)))
    watched = replace(lpv, identified_range=[[0.0], [1.5]])
    with pytest.warns(ExtrapolationWarning) as told:
        watched.grid([1.0, 2.0, 3.0])
    assert len(told) == 1


def test_names_of_signals_must_fit():
    lpv = spring_lpv()
    with pytest.raises(ValueError, match="`input_names` must be a list of 1"):
        replace(lpv, input_names=["a", "b"])


def test_control_models_bear_names():
    pytest.importorskip("control")
    lpv = replace(
        spring_lpv(),
        scheduling_names=["stiff.ness"],
        input_names=["force.1"],
        output_names=["x"],
    )
    found = lpv.to_control([0.5, -1.0])
    assert [model.name for model in found] == ["stiffpness=0p5", "stiffpness=-1"]
    assert found[0].input_labels == ["force_1"] and found[0].output_labels == ["x"]
    assert_same_matrices(StateSpace.from_control(found[0]), lpv.at(0.5), 0.0)
    assert spring_lpv().to_control([0.0])[0].input_labels == ["u1"]
    with pytest.raises(ValueError, match="model without delay"):
        replace(lpv, input_delay=0.1).to_control([0.0])


def test_a_mat_file_has_all_that_an_interpolant_needs(tmp_path):
    lpv = with_offsets(
        replace(
            spring_lpv(),
            scheduling_names=["my variable"],
            input_names=["force"],
            output_names=["position"],
            input_delay=0.2,
            units={"position": "mm"},
        )
    )
    points = [0.0, 0.5, 1.0, 1.5]
    path = tmp_path / "model.mat"
    lpv.to_mat(path, points)
    found = loadmat(path, struct_as_record=False)
    for k, model in enumerate(lpv.grid(points)):
        for name in "ABCD":
            assert_array_equal(found[name][:, :, k, 0], getattr(model, name))
        own = found["offsets"][k, 0]
        assert_allclose(own.u, [[1 + 2 * points[k]]])
        assert_allclose(own.y, 2 * own.u)
        assert_allclose(own.x, own.u * [[3], [4]])
        assert_array_equal(own.dx, np.zeros((2, 1)))
    assert_array_equal(found["SamplingGrid"][0, 0].my_variable[:, 0], points)
    assert found["Ts"] == 0 and found["InputDelay"] == 0.2
    assert found["InputName"][0, 0] == "force"
    assert found["OutputName"][0, 0] == "position"
    assert found["InputUnit"][0, 0].size == 0 and found["OutputUnit"][0, 0] == "mm"
    assert [file.name for file in tmp_path.iterdir()] == ["model.mat"]


def test_a_full_grid_is_rectangular(tmp_path):
    lpv, _ = lpv_model(PolynomialLPV(1), 2)
    points = np.array([[a, b] for b in (0.0, 1.0) for a in (0.5, 0.0, 1.0)])
    lpv.to_mat(tmp_path / "full.mat", points)
    full = loadmat(tmp_path / "full.mat", struct_as_record=False)
    grid = full["SamplingGrid"][0, 0]
    assert full["A"].shape == (3, 3, 3, 2) and full["offsets"].shape == (3, 2)
    for i, j in np.ndindex(3, 2):
        own = lpv.at([grid.kappa1[i, j], grid.kappa2[i, j]])
        assert_allclose(full["A"][:, :, i, j], own.A, atol=1e-14)
    lpv.to_mat(tmp_path / "scattered.mat", points[:5])
    scattered = loadmat(tmp_path / "scattered.mat", struct_as_record=False)
    assert scattered["A"].shape == (3, 3, 5, 1)
    assert_array_equal(scattered["SamplingGrid"][0, 0].kappa2[:, 0], points[:5, 1])


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "model.mat"
    path.write_text("old")

    def fails(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr("scipy.io.savemat", fails)
    with pytest.raises(OSError, match="no space"):
        spring_lpv().to_mat(path, [0.0])
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_names_that_are_no_identifiers_are_changed(tmp_path):
    lpv, places = lpv_model(PolynomialLPV(1), 3)
    lpv = replace(lpv, scheduling_names=["κ", "2 x", "p_"])
    lpv.to_mat(str(tmp_path / "m.mat"), places)
    grid = loadmat(tmp_path / "m.mat", struct_as_record=False)["SamplingGrid"][0, 0]
    assert len(grid._fieldnames) == 3
    assert all(name.isidentifier() and name[0].isalpha() for name in grid._fieldnames)


def test_frozen_models_know_names_and_units():
    lpv = replace(spring_lpv(), input_names=["force"], units={"force": "N"})
    assert lpv.at(0.5).input_names == ["force"] and lpv.at(0.5).output_names is None
    assert lpv.grid([0.5])[0].units == {"force": "N"}
    assert replace(lpv, input_names=[3]).at(0.5).input_names is None  # of an array
    turned = lpv.change_basis(np.diag([1.0, 2.0]))
    assert turned.at(0.5, rate=0.1).input_names == ["force"]


def test_a_dataset_has_the_models_over_the_scheduling_variables():
    pytest.importorskip("xarray")
    units = {"kappa": "m", "x": "mm"}
    lpv = with_offsets(replace(spring_lpv(), output_names=["x"], units=units))
    found = lpv.to_xarray([1.0, 0.0, 0.5])
    for k in (0.0, 0.5, 1.0):
        here = found.sel(kappa=k)
        for name in "ABCD":
            assert_array_equal(here[name], getattr(lpv.at(k), name))
        assert_allclose(here["u0"], [1 + 2 * k])
    assert found["kappa"].attrs == {"units": "m"}
    assert found["output"].item() == "x" and found["output_unit"].item() == "mm"
    two, _ = lpv_model(PolynomialLPV(1), 2)
    points = np.array([[a, b] for b in (0.0, 1.0) for a in (0.5, 0.0, 1.0)])
    full = two.to_xarray(points)
    assert full["A"].sizes == {"kappa1": 3, "kappa2": 2, "state": 3, "from_state": 3}
    assert_allclose(full["B"].sel(kappa1=0.5, kappa2=1.0), two.at([0.5, 1.0]).B)
    some = two.to_xarray(points[:5])
    assert some["A"].sizes["point"] == 5
    assert_allclose(some["B"][2], two.at([some["kappa1"][2], some["kappa2"][2]]).B)


def test_a_folder_that_is_not_there_is_told(tmp_path):
    occupied = tmp_path / "file"
    occupied.write_text("no folder")
    for folder in (tmp_path / "none", occupied):
        with pytest.raises(OSError, match="`path` .*m.mat': .*Make the folder"):
            spring_lpv().to_mat(folder / "m.mat", [0.0])
