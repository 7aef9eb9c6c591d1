"""Work shared between processes, none of which outlives the one that waits for it."""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from importlib import import_module
from typing import Any

from joblib import Parallel, delayed, effective_n_jobs
from joblib.externals.loky import reusable_executor

# A call as `joblib.delayed` writes it down: function, arguments, keywords.
Task = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]

# Tasks that processes have at a time, done or waiting: their next ones as well, or all
# but one process, whose core is left to the one that sends them.
QUEUED, ALL_BUT_ONE = "2 * n_jobs", "n_jobs - 1"

_WATCH = 0.5  # seconds between two looks at other processes

_KILLED = (
    "A worker process was killed before its work was done, most often for want of "
    "memory. Take fewer `n_jobs` (each holds its own copy of what it works on), or "
    "n_jobs=1. What was finished before is not lost where `memory` is a folder."
)


def results_of(
    tasks: Iterable[Task], n_jobs: int | None, sent: str = QUEUED
) -> Iterator[Any]:
    """Results of tasks in their order, as they come, from `n_jobs` processes.

    These are at work from now on, and have `sent` tasks at a time. Raises a
    RuntimeError where one of them is killed from outside.
    """
    watched = (delayed(_in_worker)(os.getpid(), *task) for task in tasks)
    parallel = Parallel(n_jobs=n_jobs, return_as="generator", pre_dispatch=sent)
    return _guarded(parallel(watched))


def started(n_jobs: int | None) -> Callable[[], None]:
    """Have `n_jobs` processes import what work takes while this one does other things.

    What is returned waits for them.
    """
    ready = results_of([delayed(_ready)()] * effective_n_jobs(n_jobs), n_jobs)

    def wait() -> None:
        for _ in ready:
            pass

    return wait


def _ready() -> None:
    """With this module a process imports the library, here what SciPy puts off."""
    import_module("scipy.signal")


def _guarded(results: Iterator[Any]) -> Iterator[Any]:
    done = threading.Event()
    threading.Thread(target=_watch_workers, args=(done,), daemon=True).start()
    try:
        yield from results
    except BrokenProcessPool as error:
        raise RuntimeError(_KILLED) from error
    finally:
        done.set()


def _watch_workers(done: threading.Event) -> None:
    """Break a pool of which a worker is dead for longer than Loky takes to see it.

    Killed in the middle of a result, it leaves Loky waiting for the rest of that, which
    has an end only when nobody holds the end of the pipe that is written to.
    """
    executor = reusable_executor._executor
    results = executor and executor._result_queue
    seen_dead = False
    while results is not None and not done.wait(_WATCH):
        workers = list(executor._processes.values())
        dead = any(not worker.is_alive() for worker in workers)
        if dead and seen_dead and executor._flags.broken is None:
            for worker in workers:
                worker.terminate()
            results._writer.close()
            return
        seen_dead = dead


def _in_worker(
    asked_by: int,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> Any:
    if multiprocessing.current_process().name.startswith("LokyProcess"):
        within = asked_by == os.getpid()  # a fit of a search, say
        _end_with_parent(os.getppid() if within else asked_by)
    return function(*args, **kwargs)


@cache
def _end_with_parent(parent: int) -> None:
    """Have this process end when the one that started it, and asks, has, and at once.

    Loky's wait for more work for minutes when that one was killed, and what they share
    with it stays in memory. Modules are frozen: an end that looks for cycles in them
    takes a quarter of a second, for which the other process waits.
    """
    gc.freeze()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
