"""One step of the method at every operating point: processes, progress, failures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from tqdm import tqdm

Array = NDArray[np.float64]


def over_points(
    what: str,
    function: Callable[..., Any],
    arguments: Sequence[tuple[Any, ...]],
    kappa: Array,
    *,
    n_jobs: int | None,
    verbose: int,
    on_error: str,
    **shared: Any,
) -> list[Any]:
    """Apply a step to every operating point.

    Parameters
    ----------
    what : str
        Label of the progress bar.
    function : callable
        Called with the arguments of a point and the shared keywords.
    arguments : sequence of tuple
        One for every point.
    kappa : ndarray of shape (n_points, n_scheduling)
        Names the points in messages.
    on_error : {"raise", "skip"}

    Returns
    -------
    list
        Results in order; None at the points that failed and may.
    """
    tasks = (
        delayed(attempt)(function, args, shared, k, kappa[k], on_error)
        for k, args in enumerate(arguments)
    )
    results = Parallel(n_jobs=n_jobs, return_as="generator")(tasks)
    total = len(arguments)
    return list(tqdm(results, desc=what, total=total, disable=not verbose))


def attempt(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    shared: dict[str, Any],
    number: int,
    point: Array,
    on_error: str,
) -> Any:
    """Run a step at one operating point; a failure names the point."""
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **shared)
    except (ValueError, np.linalg.LinAlgError) as error:
        place = ", ".join(f"{value:.4g}" for value in point)
        message = f"operating point {number} (scheduling {place}): {error}"
        if on_error == "raise":
            raise ValueError(message) from error
        warnings.warn(f"left out {message}", UserWarning, stacklevel=2)
        return None
