"""Compression: every engine gives the triangular factor of the pooled Hankel data."""

import numpy as np
import pytest

from lpvlearn.subspace.samples.hankel import (
    _hankel_gram,
    _hankel_matrix,
    _past_future_rows,
    _pooled_gram,
    _qr_factor,
    _reordered,
    cholesky_factor,
    correlation_sequence,
    data_factors,
    stack_factors,
    triangularize,
)


@pytest.mark.parametrize("n_samples", [37, 300, 9000])
def test_correlation_sequence_is_the_sum_of_lagged_products(rng, n_samples):
    z = rng.standard_normal((n_samples, 3))
    expected = [z[: n_samples - d].T @ z[d:] for d in range(12)]
    np.testing.assert_allclose(
        correlation_sequence(z, 12), expected, atol=1e-11 * n_samples
    )


@pytest.mark.parametrize("shape, n_rows", [((60, 3), 8), ((9, 2), 9), ((5, 1), 1)])
def test_gram_by_recursion_equals_the_product_of_the_hankel_matrix(rng, shape, n_rows):
    z = rng.standard_normal(shape)
    H = _hankel_matrix(z, n_rows)
    assert H.shape == (n_rows * shape[1], shape[0] - n_rows + 1)
    np.testing.assert_allclose(_hankel_gram([z], n_rows), H @ H.T, atol=1e-12)


def test_hankel_columns_stack_consecutive_samples(rng):
    z = rng.standard_normal((10, 2))
    np.testing.assert_array_equal(_hankel_matrix(z, 3)[:, 4], z[4:7].ravel())


def test_rows_are_ordered_future_inputs_past_inputs_past_outputs_future_outputs():
    z = np.array([[10 * t, 10 * t + 1] for t in range(4)])
    column = _hankel_matrix(z, 4)[:, 0]
    rows = _past_future_rows(1, 1, 2)
    np.testing.assert_array_equal(column[rows], [20, 30, 0, 10, 1, 11, 21, 31])
    rows = _past_future_rows(1, 1, 2, past_outputs=False)
    np.testing.assert_array_equal(column[rows], [20, 30, 0, 10, 21, 31])


@pytest.mark.parametrize("past_outputs", [True, False])
def test_cholesky_engine_equals_qr_engine(rng, past_outputs):
    records = [rng.standard_normal((n, 4)) for n in (400, 250, 90)]
    (fast,) = data_factors(records, 2, [9], past_outputs=past_outputs)
    slow = _qr_factor(records, 18, _past_future_rows(2, 2, 9, past_outputs))
    np.testing.assert_allclose(fast, slow, atol=1e-9 * np.abs(slow).max())


def test_pooled_experiments_equal_stacked_factors(rng):
    records = [rng.standard_normal((n, 3)) for n in (300, 120, 80)]
    (pooled,) = data_factors(records, 2, [5])
    stacked = stack_factors([next(data_factors([z], 2, [5])) for z in records])
    np.testing.assert_allclose(pooled, stacked, atol=1e-10)


def test_blocked_qr_equals_one_qr_of_the_whole_matrix(rng):
    z = rng.standard_normal((3000, 2))
    rows = _past_future_rows(1, 1, 3)
    whole = stack_factors([_hankel_matrix(z, 6)[rows]])
    np.testing.assert_allclose(_qr_factor([z], 6, rows), whole, atol=1e-10)


def test_no_column_crosses_the_border_between_experiments(rng):
    first, second = rng.standard_normal((50, 2)), rng.standard_normal((40, 2))
    rows = np.arange(8)
    H = np.hstack([_hankel_matrix(first, 4), _hankel_matrix(second, 4)])
    gram = _pooled_gram([first, second], 4, rows)
    np.testing.assert_allclose(gram, H @ H.T, atol=1e-10)
    L = _qr_factor([first, second], 4, rows)
    np.testing.assert_allclose(L @ L.T, H @ H.T, atol=1e-10)


def test_experiments_shorter_than_the_window_give_no_column(rng):
    z = rng.standard_normal((60, 2))
    rows = np.arange(12)
    for compress in (_pooled_gram, _qr_factor):
        np.testing.assert_array_equal(
            compress([z, z[:5]], 6, rows), compress([z], 6, rows)
        )
        assert not compress([z[:5]], 6, rows).any()


def test_singular_data_fall_back_to_qr_and_keep_their_accuracy(rng):
    z = rng.standard_normal((200, 1))
    z = np.hstack([z, 2.0 * z])
    rows = _past_future_rows(1, 1, 3)
    H = _hankel_matrix(z, 6)[rows]
    assert cholesky_factor(H @ H.T) is None
    (L,) = data_factors([z], 1, [3])
    np.testing.assert_allclose(L @ L.T, H @ H.T, atol=1e-11 * np.abs(H @ H.T).max())


def test_condition_check_sees_past_bad_scaling(rng):
    A = rng.standard_normal((6, 40))
    scale = 10.0 ** np.arange(-9, 9, 3)
    factor = cholesky_factor((A @ A.T) * np.outer(scale, scale))
    np.testing.assert_allclose(
        factor / scale[:, None], np.linalg.cholesky(A @ A.T), atol=1e-12
    )


@pytest.mark.parametrize("gram", [np.zeros((3, 3)), np.zeros((0, 0)), -np.eye(2)])
def test_cholesky_refuses_what_is_not_positive_definite(gram):
    assert cholesky_factor(gram) is None


def test_triangular_factor_has_the_gram_of_the_data(rng):
    columns = rng.standard_normal((5, 30))
    R = triangularize(columns.copy())
    np.testing.assert_allclose(R.T @ R, columns @ columns.T, atol=1e-12)
    assert triangularize(rng.standard_normal((5, 3))).shape == (3, 5)


def test_known_correlations_serve_every_horizon(rng):
    records = [rng.standard_normal((n, 3)) for n in (200, 150, 30)]
    factors = data_factors(records, 2, (2, 11, 20))  # the third for the first alone
    for horizon, factor in zip((2, 11, 20), factors, strict=True):
        (alone,) = data_factors(records, 2, [horizon])
        np.testing.assert_allclose(factor, alone, atol=1e-9)


@pytest.mark.parametrize("n_trend", [0, 1, 2])
def test_one_recursion_serves_all_experiments(rng, n_trend):
    records = [rng.standard_normal((20 + k % 30, 3)) for k in range(150)]
    each = [_hankel_gram([z], 20, n_trend=n_trend) for z in records]
    found = _hankel_gram(records, 20, n_trend=n_trend)
    np.testing.assert_allclose(found, sum(each), atol=1e-12 * found.max())
    assert (found == found.T).all()


@pytest.mark.parametrize("n_kept", [150, 149])
def test_a_gram_is_reordered_in_its_place(rng, n_kept):
    gram, rows = rng.standard_normal((150, 150)), rng.permutation(150)[:n_kept]
    expected = gram[np.ix_(rows, rows)]
    found = _reordered(gram, rows)
    np.testing.assert_array_equal(found, expected)
    assert np.shares_memory(found, gram) == (n_kept == 150)
