"""Measures of fit of the paper: BFT and VAF of outputs, FIT of parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.alignment import beside
from ..data.scoring import tell_missing
from ..data.tables import read_outputs
from ..validation import SQUARED, real_array, shown, squarable

_SMALL = 1e-100  # beside larger numbers, what squares lose is nothing

_LESS = -600  # power of two by which numbers without a square have one: all are ratios

_WORST = -1e300  # of a fit, of which the percentage is a number still

Array = NDArray[np.float64]

Multioutput = Literal["raw_values", "uniform_average"] | ArrayLike


def bft_score(
    y_true: ArrayLike,
    y_pred: ArrayLike,
    *,
    multioutput: Multioutput = "uniform_average",
) -> Any:
    """Best fit ratio of simulated outputs, in percent.

    Parameters
    ----------
    y_true, y_pred : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Measured and simulated outputs. Samples of an output that were not measured
        (NaN in `y_true`) are left out of its score, and it is told how many. Rows and
        columns of two DataFrames belong together by their labels.
    multioutput : {"raw_values", "uniform_average"} or array-like of shape (n_outputs,)
        One score per output, their mean, or their weighted mean.

    Returns
    -------
    float, or ndarray of shape (n_outputs,) for "raw_values"
        100 for a perfect simulation, 0 for one that is no better than the mean.

    Raises
    ------
    ValueError
        When shapes differ, a value is infinite, an output was never measured, or a
        simulation is NaN where there is a measurement.

    Notes
    -----
    Equation (33a) of the paper,

    .. math:: BFT = 100 \\max(1 - \\|y - \\hat y\\| / \\|y - mean(y)\\|, 0).

    An output that does not vary scores 100 if it is simulated exactly, else 0, as in
    :func:`sklearn.metrics.r2_score`.

    Examples
    --------
    >>> from lpvlearn import bft_score
    >>> bft_score([1.0, 2.0, 3.0, 4.0], [1.5, 2.5, 2.5, 3.5])
    55.27...
    """
    return _told(best_fit, y_true, y_pred, multioutput)


def best_fit(true: Array, pred: Array, multioutput: Multioutput = "raw_values") -> Any:
    """`bft_score` of matrices, NaN where not measured, without a word of these."""
    true, pred = _read_pair(true, pred)
    _check_measured(true)
    return _percent(_norm(true - pred), _norm(_centred(true)), multioutput)


def fit_of_norms(error: Array, spread: Array) -> float:
    """The mean BFT of outputs by the norms of errors, and of outputs about means."""
    return float(_percent(error, spread, "uniform_average"))


def vaf_score(
    y_true: ArrayLike,
    y_pred: ArrayLike,
    *,
    multioutput: Multioutput = "uniform_average",
) -> Any:
    """Variance of the outputs that a simulation accounts for, in percent.

    Parameters
    ----------
    y_true, y_pred : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Measured and simulated outputs. Samples of an output that were not measured
        (NaN in `y_true`) are left out of its score, and it is told how many. Rows and
        columns of two DataFrames belong together by their labels.
    multioutput : {"raw_values", "uniform_average"} or array-like of shape (n_outputs,)
        One score per output, their mean, or their weighted mean.

    Returns
    -------
    float, or ndarray of shape (n_outputs,) for "raw_values"
        100 for a simulation that is perfect up to a constant.

    Raises
    ------
    ValueError
        When shapes differ, a value is infinite, an output was never measured, or a
        simulation is NaN where there is a measurement.

    Notes
    -----
    Equation (33b) of the paper,

    .. math:: VAF = 100 \\max(1 - var(y - \\hat y) / var(y), 0).

    An output that does not vary scores 100 if the error does not either, else 0.

    Examples
    --------
    >>> from lpvlearn import vaf_score
    >>> vaf_score([1.0, 2.0, 3.0, 4.0], [1.5, 2.5, 2.5, 3.5])
    80.0
    """
    return _told(accounted_variance, y_true, y_pred, multioutput)


def accounted_variance(
    true: Array, pred: Array, multioutput: Multioutput = "raw_values"
) -> Any:
    """`vaf_score` of matrices, NaN where not measured, without a word of these."""
    true, pred = _read_pair(true, pred)
    _check_measured(true)
    error, spread = _norm(_centred(true - pred)), _norm(_centred(true))
    return _percent(error, spread, multioutput, power=2)


def parameter_fit(params_true: ArrayLike, params_pred: ArrayLike) -> float:
    """Fit of the parameters of a set of models, in percent.

    Parameters
    ----------
    params_true, params_pred : array-like of equal shape
        All parameters of all models, in any arrangement.

    Returns
    -------
    float
        100 for equal parameters; negative for parameters worse than their mean.

    Raises
    ------
    ValueError
        When shapes differ, or a value is not finite.

    Notes
    -----
    Equation (36) of the paper, with eta the vector of all parameters,

    .. math:: FIT = 100 (1 - \\|\\eta - \\hat\\eta\\| / \\|\\eta - mean(\\eta)\\|).

    Parameters that are all equal score 100 if they are met exactly, else 0.

    Examples
    --------
    >>> from lpvlearn import parameter_fit
    >>> parameter_fit([[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0], [3.0, 4.0]])
    100.0
    """
    names = ("params_true", "params_pred")
    eta, eta_hat = real_array(names[0], params_true), real_array(names[1], params_pred)
    if eta.shape != eta_hat.shape or eta.size == 0:
        raise ValueError(
            f"`{names[0]}` and `{names[1]}` must have the same shape, not empty. Got "
            f"{eta.shape} and {eta_hat.shape}."
        )
    true, pred = _read_pair(eta.ravel(), eta_hat.ravel(), names, missing=False)
    fit = _fit_ratio(_norm(true - pred), _norm(_centred(true)))[0]
    return float(100 * max(fit, _WORST))


def r2_ratio(y_true: ArrayLike, y_pred: ArrayLike) -> NDArray[np.float64]:
    """Coefficient of determination of each output, defined for a single sample too.

    Of measured samples; NaN where there are none.
    """
    true, pred = _read_pair(y_true, y_pred)
    with np.errstate(over="ignore"):
        error = np.nansum((true - pred) ** 2, axis=0)
    return _fit_ratio(error, np.nansum(_centred(true) ** 2, axis=0))


def _told(
    measure: Callable[[Array, Array, Multioutput], Any],
    y_true: ArrayLike,
    y_pred: ArrayLike,
    multioutput: Multioutput,
) -> Any:
    """A measure of outputs of any kind; tells how many are missing."""
    true, pred = _read_pair(y_true, y_pred)
    score = measure(true, pred, multioutput)
    tell_missing(true)
    return score


def _read_pair(
    y_true: Any,
    y_pred: Any,
    names: tuple[str, str] = ("y_true", "y_pred"),
    *,
    missing: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two matrices of equal shape, (n_samples, n_outputs).

    Of two tables, rows and columns belong together by their labels. Unless refused,
    `missing` values of the first are NaN in both.
    """
    y_pred = beside(y_true, y_pred, names)
    pair = zip((y_true, y_pred), names, strict=True)
    # column after column in memory, where sums take a tenth of the time
    true, pred = (
        np.asfortranarray(read_outputs(values, name)[0]) for values, name in pair
    )
    if true.shape != pred.shape or len(true) == 0:
        raise ValueError(
            f"`{names[0]}` and `{names[1]}` must have the same shape, with at least 1 "
            f"sample. Got {true.shape} and {pred.shape}."
        )
    unknown = np.isnan(true) & missing
    for array, name in ((true, names[0]), (pred, names[1])):
        finite = np.isfinite(array) | unknown
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            raise ValueError(
                f"`{name}` must be finite. Got {array[row, column]} at row {row} of "
                f"column {column}; a simulation that diverges comes from an unstable "
                "model."
            )
    pred = np.where(unknown, np.nan, pred) if unknown.any() else pred
    if max(np.nanmax(np.abs(x), initial=0.0) for x in (true, pred)) >= SQUARED:
        true, pred = np.ldexp(true, _LESS), np.ldexp(pred, _LESS)
    return true, pred


def _check_measured(true: NDArray[np.float64]) -> None:
    """Refuse an output of which every sample is missing."""
    unknown = np.isnan(true).all(axis=0)
    if unknown.any():
        raise ValueError(
            "`y_true` must hold a measured sample of every output. Got NaN throughout "
            f"column {int(np.argmax(unknown))}; leave that output or experiment out."
        )


def _centred(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Subtract the mean of each column, exactly zero where it does not vary."""
    # The rounded mean of equal numbers may differ from them in the last digit.
    known = ~np.isnan(values)
    if known.all():
        moved = values - values.sum(axis=0) / len(values)
        moved[:, values.max(axis=0) == values.min(axis=0)] = 0.0
        return moved
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, values, 0.0).sum(axis=0) / count
    highest = np.where(known, values, -np.inf).max(axis=0)
    lowest = np.where(known, values, np.inf).min(axis=0)
    return np.where(known & (highest == lowest), 0.0, values - mean)


def _norm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    if _SMALL < np.abs(values).max(initial=0.0) < SQUARED:
        return np.asarray(np.linalg.norm(values, axis=0))
    known = np.nan_to_num(values, posinf=np.inf)
    size = np.frexp(np.abs(known).max(initial=0.0))[1]  # whose squares are numbers
    with np.errstate(over="ignore"):
        return np.ldexp(np.linalg.norm(np.ldexp(known, -size), axis=0), size)


def _fit_ratio(
    error: NDArray[np.float64], spread: NDArray[np.float64], power: int = 1
) -> NDArray[np.float64]:
    """1 - (error / spread)^power; for a spread of zero, 1 without error, else 0."""
    varies = spread > 0
    with np.errstate(over="ignore"):
        ratio = 1 - (error / np.where(varies, spread, 1.0)) ** power
    return np.where(varies, ratio, error == 0)


def _percent(
    error: NDArray[np.float64],
    spread: NDArray[np.float64],
    multioutput: Multioutput,
    power: int = 1,
) -> Any:
    """Fit of the outputs in percent, at least 0, averaged as asked."""
    scores = 100 * np.maximum(_fit_ratio(error, spread, power), 0)
    if isinstance(multioutput, str):
        if multioutput == "raw_values":
            return scores
        if multioutput == "uniform_average":
            return float(scores.mean())
        raise ValueError(
            "`multioutput` must be 'raw_values', 'uniform_average' or one weight per "
            f"output. Got {multioutput!r}."
        )
    weights = squarable("multioutput", real_array("multioutput", multioutput))
    usable = np.isfinite(weights).all() and (weights >= 0).all() and weights.any()
    if weights.shape != scores.shape or not usable:
        raise ValueError(
            "`multioutput` must hold one non-negative weight for each of "
            f"{len(scores)} output(s), not all zero. Got {shown(multioutput)}."
        )
    return float(np.average(scores, weights=weights))
