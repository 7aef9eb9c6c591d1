"""One step of the method at every operating point: processes, progress, failures.

A `PointRunner` applies a function to the points, several at a time; a joblib.Memory
keeps its results; a `Stopwatch` tells what each step took.
"""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from joblib import Memory, Parallel, delayed, hash
from numpy.typing import NDArray
from sklearn.utils.validation import check_memory
from threadpoolctl import ThreadpoolController

from ..exceptions import warn

Array = NDArray[np.float64]

_SKIP = " (Mend the experiments there, or leave the point out by on_error='skip'.)"


@dataclass(frozen=True)
class PointRunner:
    """How a step is applied to the operating points.

    Attributes
    ----------
    n_jobs : int or None
        Points worked on at the same time.
    verbose : int
        1 shows a progress bar.
    on_error : {"raise", "skip"}
        Whether a point that fails stops the others.
    memory : joblib.Memory
        Where results are kept; without a location, nowhere.
    """

    n_jobs: int | None
    verbose: int
    on_error: str
    memory: Memory

    def run(
        self,
        what: str,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        kappa: Array,
        **shared: Any,
    ) -> list[Any]:
        """Apply a step to every operating point.

        Parameters
        ----------
        what : str
            Label of the progress bar.
        function : callable
            Called with the arguments of a point and the shared keywords. The memory
            knows its results by the values of all of them.
        arguments : sequence of tuple
            One for every point.
        kappa : ndarray of shape (n_points, n_scheduling)
            Names the points in messages.

        Returns
        -------
        list
            Results in order; None at the points that failed and may.

        Raises
        ------
        ValueError
            If a point fails and must not, or all of them do. The message names the
            point, unless another one fails in the same words: the cause is an option
            then.
        """
        kept = self._remembered(function)
        stop = self.on_error == "raise"
        tasks = (
            delayed(_attempt)(kept, args, shared, k if stop else None)
            for k, args in enumerate(arguments)
        )
        results = Parallel(n_jobs=self.n_jobs, return_as="generator")(tasks)
        if self.verbose:
            from tqdm import tqdm  # slow to import

            results = tqdm(results, desc=what, total=len(arguments))
        try:
            found = list(results)
        except _Stopped as stopped:
            k, error = stopped.args
            # The point, or an option? A neighbour (the last for the first) tells.
            other = _attempt(kept, arguments[k - 1], shared, None)
            if isinstance(other, _Failure) and other.text == str(error):
                raise ValueError(str(error)) from error
            skip = "" if "on_error" in str(error) else _SKIP
            raise ValueError(f"{_place(k, kappa)}: {error}{skip}") from error
        failures = {k: r for k, r in enumerate(found) if isinstance(r, _Failure)}
        if len(failures) == len(found):
            first = found[0]
            if all(failure.text == first.text for failure in failures.values()):
                raise ValueError(first.text) from first.error
            raise ValueError(
                f"{what}: every operating point failed. First {_place(0, kappa)}: "
                f"{first.text}"
            ) from first.error
        for k, failure in failures.items():
            warn(f"left out {_place(k, kappa)}: {failure.text}")
        return [None if isinstance(r, _Failure) else r for r in found]

    def call(
        self, function: Callable[..., Any], *args: Any, ignore: Sequence[str] = ()
    ) -> Any:
        """Call a function, or take its result from the memory.

        Parameters
        ----------
        function : callable
            At the top of a module.
        *args
        ignore : sequence of str
            Arguments that follow from the others and do not tell results apart.
        """
        return self._remembered(function, ignore)(*args)

    def _remembered(
        self, function: Callable[..., Any], ignore: Sequence[str] = ()
    ) -> Callable[..., Any]:
        if hasattr(self.memory, "store_backend"):
            return _Remembered(function, self.memory.store_backend, tuple(ignore))
        # An object with the interface of joblib.Memory: its own affair.
        return self.memory.cache(function, ignore=list(ignore))


@dataclass(frozen=True)
class _Remembered:
    """A function whose results a store keeps by the values of its arguments.

    What ``joblib.Memory.cache`` does, without its record of the arguments as text:
    joblib warns the user where writing that took long, as under load it may.

    Attributes
    ----------
    function : callable
        At the top of a module.
    store : joblib store backend or None
        Of a joblib.Memory; None keeps nothing.
    ignore : tuple of str
        As in `PointRunner.call`.
    """

    function: Callable[..., Any]
    store: Any
    ignore: tuple[str, ...] = ()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The result for these arguments: the one kept, else a new one."""
        if self.store is None:
            return self.function(*args, **kwargs)
        item = self._item(args, kwargs)
        if self.store.contains_item(item):
            try:
                return self.store.load_item(item, verbose=0)
            except Exception:  # cleared meanwhile, or damaged: it is made again
                pass
        result = self.function(*args, **kwargs)
        self.store.dump_item(item, result, verbose=0)
        return result

    def _item(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[str]:
        """Place in the store: folders of the function, and of source and arguments."""
        named = inspect.signature(self.function).bind(*args, **kwargs).arguments
        told = {name: v for name, v in named.items() if name not in self.ignore}
        folder = f"{self.function.__module__}.{self.function.__qualname__}"
        # Results of another version of the function are not taken for its own.
        source = inspect.getsource(self.function)
        return [folder, hash((source, told), coerce_mmap=True)]


def checked_memory(memory: Any, steps: dict[str, Any]) -> Memory:
    """A joblib.Memory from the argument `memory`, usable for steps.

    Parameters
    ----------
    memory : None, str, path or object with the interface of joblib.Memory
    steps : dict of str to estimator
        By the names of the arguments.

    Raises
    ------
    ValueError
        If `memory` is none of these, or a step cannot be pickled.
    """
    path = str(memory) if hasattr(memory, "__fspath__") else memory
    try:
        memory = check_memory(path)  # which takes a path as text only
    except ValueError as error:
        raise ValueError(
            "`memory` must be None, a folder, or a joblib.Memory. Got "
            f"{type(memory).__name__}."
        ) from error
    if getattr(memory, "location", None) is None:
        return memory
    for name, step in steps.items():
        try:
            hash(step)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ValueError(
                f"`memory` needs steps that can be pickled. Got a `{name}` that cannot "
                f"({error}): replace lambda and nested functions by functions at the "
                "top of a module, or leave `memory` out."
            ) from error
    return memory


@dataclass
class Stopwatch:
    """Wall-clock seconds of each step, in the order of the steps."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Add the time that the block takes to the step."""
        start = perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - start

    def table(self) -> pd.DataFrame:
        """Columns step and seconds, with the total."""
        rows = [*self.seconds.items(), ("total", sum(self.seconds.values()))]
        return pd.DataFrame(rows, columns=["step", "seconds"])


@dataclass(frozen=True)
class _Failure:
    """Why a point failed."""

    error: Exception

    @property
    def text(self) -> str:
        return str(self.error)


class _Stopped(Exception):
    """A failure that ends the step: number of the point, and error."""


def _attempt(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    shared: dict[str, Any],
    stop_as: int | None,
) -> Any:
    """Run a step at one operating point; `stop_as` is its number if it must succeed."""
    try:
        with _blas().limit(limits=1, user_api="blas"):
            return function(*args, **shared)
    except (ValueError, np.linalg.LinAlgError) as error:
        if stop_as is not None:
            raise _Stopped(stop_as, error) from error
        return _Failure(error)  # told by the runner, who knows the other points


@cache
def _blas() -> ThreadpoolController:
    """Found once in every process: the search takes longer than a small step."""
    return ThreadpoolController()


def _place(number: int, kappa: Array) -> str:
    values = ", ".join(f"{value:.4g}" for value in kappa[number])
    return f"operating point {number} (scheduling {values})"
