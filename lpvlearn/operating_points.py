"""Operating points: experiments grouped by where the scheduling variable stood."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from .experiments import Experiment


def group_operating_points(
    experiments: Sequence[Experiment], tol: ArrayLike | None = None
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Group experiments by operating point.

    Experiments with an operating-point label are grouped by it; the others by the mean
    of their scheduling variable.

    Parameters
    ----------
    experiments : list of Experiment
    tol : float or array-like of shape (n_scheduling,), optional
        Largest distance, in units of each scheduling variable, between the means of
        experiments of one point. Default: the larger of 1 % of the range of the means
        and the median spread of the variable within an experiment.

    Returns
    -------
    index : ndarray of int, shape (n_experiments,)
        Operating point of each experiment.
    kappa : ndarray of shape (n_points, n_scheduling)
        Scheduling value of each point, the mean of its experiments' means, in
        lexicographic order; `n_scheduling` is 0 without scheduling columns (points are
        then in the order of first appearance).

    Raises
    ------
    ValueError
        When experiments form a chain closer than `tol`, so that groups are not clear.

    Examples
    --------
    >>> import pandas as pd
    >>> from sklearn.base import BaseEstimator
    >>> from lpvlearn.experiments import read_experiments
    >>> from lpvlearn.operating_points import group_operating_points
    >>> X = pd.DataFrame({"u": 1.0, "kappa": [0.9, 0.1, 0.9], "run": [7, 8, 9]})
    >>> runs = read_experiments(
    ...     BaseEstimator(), X, scheduling="kappa", experiment="run"
    ... )
    >>> index, kappa = group_operating_points(runs)
    >>> index, kappa.ravel()
    (array([1, 0, 1]), array([0.1, 0.9]))
    """
    signals = [run.scheduling for run in experiments if run.scheduling is not None]
    means = None
    if len(signals) == len(experiments):
        means = np.array([signal.mean(axis=0) for signal in signals])
    if all(run.operating_point is not None for run in experiments):
        group, _ = pd.factorize(
            pd.Series([run.operating_point for run in experiments], dtype=object)
        )
    elif means is None:
        group = np.zeros(len(experiments), dtype=np.intp)
    else:
        group = _cluster(means, _tolerance(signals, means, tol))
    n_points = int(group.max()) + 1
    if means is None:
        return group, np.empty((n_points, 0))
    kappa = np.array([means[group == k].mean(axis=0) for k in range(n_points)])
    order = np.lexsort(kappa.T[::-1])
    return np.argsort(order)[group], kappa[order]


def check_local(
    experiments: Sequence[Experiment],
    kappa: NDArray[np.float64],
    *,
    max_spread: float = 0.25,
) -> None:
    """Check that the scheduling variable barely moves within each experiment.

    Parameters
    ----------
    experiments : list of Experiment
    kappa : ndarray of shape (n_points, n_scheduling)
        Operating points, as `group_operating_points` returns them.
    max_spread : float, default=0.25
        Largest spread (maximum minus minimum) of a scheduling variable within an
        experiment, relative to its range over the operating points; relative to its
        largest magnitude where the range is zero.

    Raises
    ------
    ValueError
        When an experiment is not local.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.experiments import Experiment
    >>> from lpvlearn.operating_points import check_local
    >>> sweep = Experiment(
    ...     "sweep", np.arange(2), np.ones((2, 1)), scheduling=np.array([[0.0], [1.0]])
    ... )
    >>> check_local([sweep], np.array([[0.0], [1.0]]))
    Traceback (most recent call last):
        ...
    ValueError: Experiment 'sweep' must be local. Its scheduling variable 1 spreads ...
    """
    for run in experiments:
        if run.scheduling is None or run.scheduling.shape[1] == 0:
            continue
        spread = np.ptp(run.scheduling, axis=0)
        extent = np.ptp(kappa, axis=0)
        scale = np.where(extent > 0, extent, np.abs(run.scheduling).max(axis=0))
        excess = spread - max_spread * scale
        worst = int(np.argmax(excess))
        if excess[worst] > 0:
            raise ValueError(
                f"Experiment {run.label!r} must be local. Its scheduling variable "
                f"{worst + 1} spreads over {spread[worst]:.4g}, more than "
                f"{max_spread:g} times the range of the operating points "
                f"({extent[worst]:.4g}). Keep such a record for validation, or cut it "
                "into local experiments."
            )


def _tolerance(
    signals: Sequence[NDArray[np.float64]],
    means: NDArray[np.float64],
    tol: ArrayLike | None,
) -> NDArray[np.float64]:
    if tol is None:
        spreads = [np.ptp(signal, axis=0) for signal in signals]
        return np.maximum(0.01 * np.ptp(means, axis=0), np.median(spreads, axis=0))
    given = np.asarray(tol, dtype=np.float64)
    if given.shape not in ((), (means.shape[1],)) or not (given >= 0).all():
        raise ValueError(
            "`scheduling_tol` must be a non-negative number, or one per scheduling "
            f"variable ({means.shape[1]}). Got {tol!r}."
        )
    return np.broadcast_to(given, means.shape[1:])


def _cluster(means: NDArray[np.float64], tol: NDArray[np.float64]) -> NDArray[np.intp]:
    """Group means that are within `tol`, whatever their order."""
    distance = np.abs(means[:, None, :] - means[None, :, :])
    near = (distance <= tol).all(axis=2)
    _, group = connected_components(csr_array(near), directed=False)
    for k in range(group.max() + 1):
        extent = np.ptp(means[group == k], axis=0)
        if (extent > 3 * tol).any():
            j = int(np.argmax(extent - 3 * tol))
            raise ValueError(
                "`scheduling_tol` must separate the operating points. With "
                f"{tol[j]:.4g}, {int((group == k).sum())} experiments form one chain "
                f"over {extent[j]:.4g} of scheduling variable {j + 1}. Give a smaller "
                "`scheduling_tol` (0: every experiment is a point), or label the "
                "points with an `operating_point` column."
            )
    return group.astype(np.intp)
