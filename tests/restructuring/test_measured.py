"""Tables of frequency responses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure
from lpvlearn.restructuring.measured import (
    read_frequency_data,
    read_noise,
    stack_response,
)


def response(n_freq=5, n_outputs=2, n_inputs=3, seed=0):
    rng = np.random.default_rng(seed)
    shape = (n_freq, n_outputs, n_inputs)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def test_tables_and_responses_are_the_same_thing():
    omega, G = np.array([3.0, 0.0, 1.0, 2.0, 9.0]), response()
    table = stack_response(G)
    assert_array_equal(table[:, 4], G[:, 1, 1].real)
    assert_array_equal(table[:, 6 + 4], G[:, 1, 1].imag)
    for grid in (omega, omega[:, None], omega.tolist()):
        for frf in (table, table.tolist(), G, G.reshape(5, 6)):
            read_omega, read_G = read_frequency_data(grid, frf, 2, 3)
            assert_array_equal(read_omega, omega)
            assert_array_equal(read_G, G)


def test_one_channel_may_be_a_complex_vector():
    G = response(4, 1, 1)
    assert_array_equal(read_frequency_data(np.arange(4.0), G[:, 0, 0], 1, 1)[1], G)


OMEGA, TABLE = np.arange(1.0, 6.0), stack_response(response())
BROKEN = TABLE.copy()
BROKEN[3, 1] = np.nan


@pytest.mark.parametrize(
    "omega, frf, message",
    [
        ([], np.zeros((0, 12)), r"`omega` must have shape \(n_freq,\)"),
        (np.ones((5, 2)), TABLE, r"`omega` must have shape.*\(5, 2\)"),
        (3.0, TABLE, "`omega` must have shape"),
        ("dc", TABLE, "`omega` must hold real"),
        (OMEGA * 1j, TABLE, "`omega` must hold real"),
        (-OMEGA, TABLE, "`omega` must be finite, not negative"),
        ([0.0], TABLE[:1], "`omega` must be finite, not negative, and not only zero"),
        ([1, 2, 3, 4, np.inf], TABLE, "`omega` must be finite"),
        ([1, 2, 3, 4, 4], TABLE, "`omega` must hold every frequency once"),
        (OMEGA, TABLE[:4], r"`frf` must have shape \(5, 12\).*\(4, 12\)"),
        (OMEGA, TABLE[:, :6], r"`frf` must have shape \(5, 12\).*\(5, 6\)"),
        (OMEGA, response(4), r"complex `frf` must have shape \(5, 2, 3\)"),
        (OMEGA[:1], np.complex128(1), "complex `frf` must have shape"),
        (OMEGA, response().transpose(1, 0, 2), "complex `frf` must have shape"),
        (OMEGA, "table", "`frf` must hold real"),
        (OMEGA, BROKEN, "`frf` must be finite.*row 3"),
    ],
)
def test_wrong_data_are_explained(omega, frf, message):
    with pytest.raises(ValueError, match=message):
        read_frequency_data(omega, frf, 2, 3)


# -- known noise -----------------------------------------------------------------------

GAIN = GrayBoxStructure.from_template(
    np.zeros((0, 0)).tolist(), np.zeros((0, 1)).tolist(), [[]], [["d"]]
)


def test_a_coherence_is_a_noise():
    G, rng = response(4, 2, 3), np.random.default_rng(1)
    c = rng.uniform(0.2, 0.9, G.shape)
    std = read_noise(None, c, 10, G)
    assert_allclose(std**2, np.abs(G) ** 2 * (1 - c) / (10 * c))
    assert_allclose(read_noise(std, None, None, G), std)
    whole = read_noise(np.full(4, 0.1), None, None, G)
    assert whole.shape == G.shape and (whole == 0.1).all()
    assert (read_noise(None, np.ones(4), 5, G) > 0).all()
    assert read_noise(None, None, None, G) is None


@pytest.mark.parametrize(
    "known, message",
    [
        ({"noise": [0.1]}, r"`noise` must have shape \(5,\) or \(5, 2, 3\).*\(1,\)"),
        ({"noise": np.zeros(5)}, "`noise` must have.*values above 1e-100"),
        ({"noise": np.full(5, np.nan)}, "`noise` must have"),
        ({"coherence": np.full(5, 1.1), "n_averages": 4}, "`coherence`.*above 1e-100"),
        ({"coherence": np.full(5, 0.9)}, "`n_averages` must be an integer"),
        ({"coherence": np.ones(5), "noise": np.ones(5)}, "give one of them"),
    ],
)
def test_wrong_noise_is_explained(known, message):
    values = dict.fromkeys(("noise", "coherence", "n_averages")) | known
    with pytest.raises(ValueError, match=message):
        read_noise(*values.values(), response())


def test_a_response_of_zeros_is_refused():
    with pytest.raises(ValueError, match="`frf` must not be zero"):
        GrayBoxRestructurer(GAIN).fit(OMEGA, np.zeros((5, 2)))


def test_weighed_by_its_noise_a_gain_is_the_weighted_mean():
    rng, omega = np.random.default_rng(0), np.arange(1.0, 31.0)[::-1]
    std = rng.uniform(0.05, 0.5, 30)
    G = 2.0 + std * (rng.normal(size=(2, 30)).T @ [1, 1j]) / np.sqrt(2)
    weight = 2.0 / std**2
    fitted = GrayBoxRestructurer(GAIN, norm="covariance").fit(omega, G, noise=std)
    mean = np.sum(weight * G.real) / weight.sum()
    assert_allclose(fitted.params_, mean, rtol=1e-7)
    assert_allclose(fitted.params_covariance_, 1.0 / weight.sum(), rtol=1e-9)
    assert_allclose(fitted.chi2_, np.sum(weight * np.abs(G - mean) ** 2), rtol=1e-9)
    assert fitted.degrees_of_freedom_ == 59 and fitted.p_value_ > 1e-3
    with pytest.raises(ValueError, match="needs the `noise`"):
        fitted.fit(omega, G)
    with pytest.raises(ValueError, match="`sample_weight` must be None"):
        fitted.fit(omega, G, np.ones(30), noise=std)


def test_errors_count_in_standard_deviations_of_the_noise():
    """Noise as large everywhere changes no parameter; more of it, their covariance."""
    lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    rng, omega = np.random.default_rng(0), np.geomspace(0.1, 10.0, 25)
    noise = 0.005 * (rng.normal(size=(2, 25)).T @ [1, 1j])
    frf = 3.0 / (1j * omega + 2.0) + noise
    plain = GrayBoxRestructurer(lag).fit(omega, frf)
    known, more = (
        GrayBoxRestructurer(lag).fit(omega, frf, noise=np.full(25, std))
        for std in (0.01, 0.02)
    )
    for fitted in (known, more):
        assert_allclose(fitted.params_, plain.params_, rtol=1e-5)
    assert_allclose(known.error_ * 0.01, plain.error_, rtol=1e-6)
    ratio = np.sqrt(
        np.diag(more.params_covariance_) / np.diag(known.params_covariance_)
    )
    assert_allclose(ratio, 2.0, rtol=0.2)
    table = known.confidence_intervals(0.999)
    assert ((table["lower"] < [2, 3]) & (table["upper"] > [2, 3])).all()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 6])
@pytest.mark.filterwarnings("ignore")
def test_fewer_data_than_parameters_raise_nothing(count):
    structure = GrayBoxStructure.observable_canonical(5)
    omega = np.geomspace(0.1, 5.0, count)
    frf = response(count, 1, 1, seed=3)
    fitted = GrayBoxRestructurer(structure, n_starts=2, max_iter=10).fit(omega, frf)
    assert fitted.lti_.is_stable and np.isfinite(fitted.params_).all()
