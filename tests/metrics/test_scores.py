"""Measures of fit against independent formulas."""

from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import r2_score

from lpvlearn import (
    bft_score,
    parameter_fit,
    vaf_score,
)
from lpvlearn.metrics.scores import r2_ratio

from .conftest import RNG, Y_PRED, Y_TRUE


def test_bft_is_one_minus_the_root_of_one_minus_r2():
    r2 = r2_score(Y_TRUE, Y_PRED, multioutput="raw_values")
    np.testing.assert_allclose(
        bft_score(Y_TRUE, Y_PRED, multioutput="raw_values"),
        100 * (1 - np.sqrt(1 - r2)),
    )
    np.testing.assert_allclose(r2_ratio(Y_TRUE, Y_PRED), r2)


def test_vaf_is_the_r2_of_centred_signals():
    centred = Y_TRUE - Y_TRUE.mean(axis=0), Y_PRED - Y_PRED.mean(axis=0)
    r2 = r2_score(*centred, multioutput="raw_values")
    vaf = vaf_score(Y_TRUE, Y_PRED, multioutput="raw_values")
    np.testing.assert_allclose(vaf, 100 * r2)


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_scores_run_from_zero_to_hundred(score):
    assert score(Y_TRUE, Y_TRUE) == 100
    assert score(Y_TRUE, -Y_TRUE) == 0
    assert score(Y_TRUE, 1e200 * Y_TRUE) == 0
    np.testing.assert_allclose(
        score(Y_TRUE, 0.5 * (Y_TRUE - Y_TRUE.mean(axis=0)) + Y_TRUE.mean(axis=0)),
        50 if score is bft_score else 75,
    )


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_scores_do_not_depend_on_units(score):
    scale, offset = np.array([1e-6, 1e6]), np.array([0.1, 1e3])
    np.testing.assert_allclose(
        score(scale * Y_TRUE + offset, scale * Y_PRED + offset),
        score(Y_TRUE, Y_PRED),
        rtol=1e-9,
    )


def test_a_constant_offset_of_the_simulation_costs_bft_and_no_vaf():
    assert bft_score(Y_TRUE, Y_TRUE + 0.3) < 80
    np.testing.assert_allclose(vaf_score(Y_TRUE, Y_TRUE + 0.3), 100)


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3])
def test_a_constant_output_scores_all_or_nothing(value):
    true = np.full((7, 1), value)
    assert bft_score(true, true) == vaf_score(true, true) == 100
    assert bft_score(true, true + 1) == 0
    assert vaf_score(true, true + 1) == 100
    assert vaf_score(true, true + np.arange(7)[:, None]) == 0
    assert parameter_fit(true, true) == 100
    assert parameter_fit(true, true + 1) == 0


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_outputs_are_averaged_as_asked(score):
    raw = score(Y_TRUE, Y_PRED, multioutput="raw_values")
    assert raw.shape == (2,)
    np.testing.assert_allclose(score(Y_TRUE, Y_PRED), raw.mean())
    weighted = score(Y_TRUE, Y_PRED, multioutput=[3, 1])
    np.testing.assert_allclose(weighted, (3 * raw[0] + raw[1]) / 4)
    assert isinstance(weighted, float)
    np.testing.assert_allclose(score(Y_TRUE[:, 0], Y_PRED[:, :1]), raw[0])
    np.testing.assert_allclose(score(pd.DataFrame(Y_TRUE), Y_PRED.tolist()), raw.mean())


def test_parameter_fit_is_the_unclipped_ratio_of_all_parameters_together():
    eta = RNG.normal(size=(7, 16))
    eta_hat = eta + 0.1 * RNG.normal(size=eta.shape)
    expected = 100 * (1 - np.sqrt(1 - r2_score(eta.ravel(), eta_hat.ravel())))
    np.testing.assert_allclose(parameter_fit(eta, eta_hat), expected)
    np.testing.assert_allclose(parameter_fit(eta, 3 * eta - 2 * eta.mean()), -100)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: bft_score([1, 2], [1, 2, 3]), ["same shape", "(2, 1)", "(3, 1)"]),
        (lambda: vaf_score(Y_TRUE, Y_TRUE[:, :1]), ["same shape", "(50, 1)"]),
        (lambda: bft_score([1, 2], [1, np.inf]), ["`y_pred`", "row 1", "unstable"]),
        (lambda: bft_score([np.inf, 2], [1, 2]), ["`y_true`", "row 0"]),
        (lambda: bft_score([1, 2], [1, np.nan]), ["`y_pred`", "row 1"]),
        (lambda: vaf_score([[1, np.nan]], [[1, 2]]), ["measured sample", "column 1"]),
        (lambda: bft_score([1, 2], [1, 2], multioutput="mean"), ["'mean'"]),
        (lambda: bft_score(Y_TRUE, Y_PRED, multioutput=[1]), ["2 output(s)", "[1]"]),
        (lambda: parameter_fit([1, 2], [[1, 2]]), ["`params_true`", "(1, 2)"]),
        (lambda: parameter_fit([1, np.nan], [1, 2]), ["`params_true`", "row 1"]),
    ],
)
def test_bad_calls_raise_and_name_the_cause(call, words):
    with pytest.raises(ValueError) as raised:
        call()
    for word in words:
        assert word in str(raised.value)


@pytest.mark.parametrize("score", [bft_score, vaf_score, r2_ratio])
def test_missing_samples_of_an_output_are_left_out_of_its_score(score):
    lost = np.random.default_rng(4).random(Y_TRUE.shape) < 0.3
    options = {} if score is r2_ratio else {"multioutput": "raw_values"}
    told = pytest.warns(UserWarning, match=f"^{lost.sum()} of {lost.size} values")
    silent = nullcontext() if score is r2_ratio else told
    with silent:
        found = score(np.where(lost, np.nan, Y_TRUE), Y_PRED, **options)
    for k in (0, 1):
        known = ~lost[:, k]
        alone = score(Y_TRUE[known, k], Y_PRED[known, k], **options)
        np.testing.assert_allclose(found[k], alone, rtol=1e-12)
    # A simulation need not be known where nothing was measured.
    both = np.where(lost, np.nan, Y_TRUE), np.where(lost, np.nan, Y_PRED)
    with silent:
        np.testing.assert_array_equal(score(*both, **options), found)


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_rows_and_columns_of_tables_belong_together_by_their_labels(score):
    true, pred = (pd.DataFrame(y, columns=["a", "b"]) for y in (Y_TRUE, Y_PRED))
    raw = {"multioutput": "raw_values"}
    expected = score(true, pred, **raw)
    np.testing.assert_array_equal(score(true, pred[["b", "a"]], **raw), expected)
    order = np.random.default_rng(0).permutation(len(true))
    with pytest.warns(UserWarning, match="`y_pred` has the row labels of y_true in an"):
        np.testing.assert_allclose(score(true.iloc[order], pred, **raw), expected)
    with pytest.raises(ValueError, match="`y_pred` must have the outputs"):
        score(true, pred.set_axis(["b", "c"], axis=1))
