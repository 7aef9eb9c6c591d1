"""Any step at several operating points at a time.

A `PointRunner` tells progress and failures, and keeps results in a memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from joblib import Memory, delayed
from numpy.typing import NDArray

from ...exceptions import Told, collected, warn
from ...systems.threads import one_blas_thread
from ...validation import number_shown
from .memory import Remembered, RememberedElsewhere
from .workers import results_of

Array = NDArray[np.float64]

# A number of a message, but those in names (H2, p_1, A[0]) and versions
_NUMBER = re.compile(r"(?<![\w.\[])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w\]]|\.\d)")

_SKIP = " (Mend the experiments there, or leave the point out by on_error='skip'.)"


@dataclass(frozen=True)
class PointRunner:
    """How a step is applied to the operating points."""

    n_jobs: int | None  # points worked on at the same time
    verbose: int  # 1 shows a progress bar
    on_error: str  # "raise" or "skip": whether a point that fails stops the others
    memory: Memory  # where results are kept; without a location, nowhere

    def run(
        self,
        what: str,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        kappa: Array,
        known: Sequence[Done | None] = (),
        **shared: Any,
    ) -> list[Done | None]:
        """Results of a step at every operating point; None where it failed and may.

        Those that are `known` stand for themselves, the step is taken where None does.

        What the points warn of comes with them: given at once, warnings would tear
        the progress bar, name no point, and be lost in other processes.

        The function takes the arguments of a point and the shared keywords; the memory
        knows its results by the values of all of them. `what` labels the progress bar.
        A failure names the point (by `kappa`), unless another one fails in the same
        words: the cause is an option then.
        """
        return self.start(what, function, arguments, kappa, known, **shared)()

    def start(
        self,
        what: str,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        kappa: Array,
        known: Sequence[Done | None] = (),
        **shared: Any,
    ) -> Callable[[], list[Done | None]]:
        """As `run`, whose results a call of what is returned waits for.

        Other processes are at work in the meantime.
        """
        kept = self._remembered(function)
        stop = self.on_error == "raise"
        known = known or [None] * len(arguments)
        tasks = (
            delayed(_attempt)(kept, args, shared, k if stop else None)
            for k, args in enumerate(arguments)
            if known[k] is None
        )
        new = results_of(tasks, self.n_jobs)
        results = (next(new) if done is None else done for done in known)

        def again(k: int) -> Any:
            return _attempt(kept, arguments[k], shared, None)

        return lambda: self._wait(results, what, kappa, again)

    def _wait(
        self, results: Any, what: str, kappa: Array, again: Callable[[int], Any]
    ) -> list[Done | None]:
        if self.verbose:
            from tqdm import tqdm  # slow to import

            results = tqdm(results, desc=what, total=len(kappa))
        found: list[Done | _Failure] = []
        try:
            found.extend(results)
        except _Stopped as stopped:
            k, error, told = stopped.args
            if self.verbose:
                results.close()  # or the warnings would stand in the bar's line
            tell_skipped([*_done(found[:k]), Done(None, told)], kappa)
            # The point, or an option? A neighbour (the last for the first) tells.
            other = again(k - 1)
            if isinstance(other, _Failure) and other.text == str(error):
                raise ValueError(str(error)) from error
            skip = "" if "on_error" in str(error) else _SKIP
            raise ValueError(f"{place_of(k, kappa)}: {error}{skip}") from error
        failures = {k: r for k, r in enumerate(found) if isinstance(r, _Failure)}
        if len(failures) == len(found):
            first = failures[0]
            if all(failure.text == first.text for failure in failures.values()):
                raise ValueError(first.text) from first.error
            raise ValueError(
                f"{what}: every operating point failed. First {place_of(0, kappa)}: "
                f"{first.text}"
            ) from first.error
        for k, failure in failures.items():
            warn(f"left out {place_of(k, kappa)}: {failure.text}")
        return _done(found)

    def call(
        self, function: Callable[..., Any], *args: Any, ignore: Sequence[str] = ()
    ) -> Any:
        """Call a function at the top of a module, or take its result from the memory.

        The arguments to `ignore` follow from the others and do not tell results apart.
        """
        return self._remembered(function, ignore)(*args)

    def _remembered(
        self, function: Callable[..., Any], ignore: Sequence[str] = ()
    ) -> Callable[..., Any]:
        if hasattr(self.memory, "store_backend"):
            return Remembered(function, self.memory.store_backend, tuple(ignore))
        # An object with the interface of joblib.Memory: its own affair.
        return RememberedElsewhere(self.memory, function, tuple(ignore))


class Done(NamedTuple):
    """The result of a step at a point, and what was told on the way."""

    result: Any
    told: list[Told]


@dataclass(frozen=True)
class _Failure:
    """Why a point failed."""

    error: Exception

    @property
    def text(self) -> str:
        return str(self.error)


class _Stopped(Exception):
    """A failure that ends the step: number of the point, error, what was told."""


def _attempt(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    shared: dict[str, Any],
    stop_as: int | None,
) -> Any:
    """Run a step at one operating point; `stop_as` is its number if it must succeed."""
    told: list[Told] = []
    try:
        with one_blas_thread, collected() as told:
            return Done(function(*args, **shared), told)
    except (ValueError, np.linalg.LinAlgError) as error:
        if stop_as is not None:
            raise _Stopped(stop_as, error, told) from error
        return _Failure(error)  # told by the runner, who knows the other points


def _done(found: Sequence[Done | _Failure]) -> list[Done | None]:
    return [result if isinstance(result, Done) else None for result in found]


def tell_skipped(found: Sequence[Done | None], kappa: Array) -> None:
    """Give the warnings of all points: each once, with the points that it came from.

    Those that differ in numbers alone are one, which tells their ranges.
    """
    kinds: dict[Told, list[tuple[int, str]]] = {}
    for k, done in enumerate(found):
        for one in done.told if done is not None else ():
            kind = one._replace(message=_NUMBER.sub("#", one.message))
            kinds.setdefault(kind, []).append((k, one.message))
    for kind, told in kinds.items():
        points = dict.fromkeys(k for k, _ in told)
        message = _ranges_told([text for _, text in told])
        place = "all operating points"
        if len(points) < len(kappa):
            place = ", ".join(place_of(k, kappa) for k in points)
        warn(
            message if len(kappa) == 1 else f"{message} (At {place}.)",
            kind.category,
            kind.kind,
        )


def _ranges_told(texts: Sequence[str]) -> str:
    """The first of texts that differ in numbers: with the least "to" the largest."""
    ranges = []
    for values in zip(*map(_NUMBER.findall, texts), strict=True):
        least, largest = (end(values, key=float) for end in (min, max))
        same = float(least) == float(largest)
        ranges.append(least if same else f"{least} to {largest}")
    told = iter(ranges)
    return _NUMBER.sub(lambda _: next(told), texts[0])


def place_of(number: int, kappa: Array) -> str:
    return f"operating point {number} (scheduling {label_of(kappa[number])})"


def label_of(kappa: Array) -> str:
    return ", ".join(map(number_shown, kappa))
