"""Work shared between processes, none of which outlives the one that waits for it."""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from numbers import Integral
from typing import Any

from joblib import Parallel, cpu_count, delayed, effective_n_jobs
from joblib.externals.loky import reusable_executor
from joblib.parallel import get_active_backend

from ...systems.worker import WATCH, end_with_parent
from ...validation import shown

# A call as `joblib.delayed` writes it down: function, arguments, keywords.
Task = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]

_NICE = 3  # half the share of a processor that others have

_KILLED = (
    "A worker process was killed before its work was done, most often for want of "
    "memory. Take fewer `n_jobs` (each holds its own copy of what it works on), or "
    "n_jobs=1. What was finished before is not lost where `memory` is a folder."
)

_UNREADABLE = (
    "A worker process could not read its task, most often for a module that only this "
    "one finds (by a path added to `sys.path`, say): {cause}. Install that module, "
    "name its folder in PYTHONPATH, or take n_jobs=1."
)


def check_jobs(n_jobs: Any) -> int | None:
    """The argument `n_jobs` as joblib takes it, or a ValueError."""
    if n_jobs is None or (isinstance(n_jobs, Integral) and n_jobs != 0):
        return None if n_jobs is None else int(n_jobs)
    raise ValueError(
        "`n_jobs` must be None or an integer, -1 for all processors, not 0. Got "
        f"{shown(n_jobs)}."
    )


def results_of(tasks: Iterable[Task], n_jobs: int | None) -> Iterator[Any]:
    """Results of tasks in their order, as they come, from `n_jobs` processes.

    No more than the larger of these numbers, that of tasks or that of processors.

    All at once where the backend of joblib cannot send them one by one, as Ray's.
    These are at work from now on. Raises a RuntimeError where one of them is killed
    from outside.
    """
    tasks, n_jobs = list(tasks), check_jobs(n_jobs)
    if n_jobs is not None:  # more of them would wait, or be too many to begin
        n_jobs = min(n_jobs, max(len(tasks), cpu_count()))
    backend, _ = get_active_backend()
    as_they_come = "generator" if backend.supports_return_generator else "list"
    parallel = Parallel(n_jobs=n_jobs, return_as=as_they_come)
    with _broken_pools_told():  # by a first task, while others are sent
        results = iter(parallel(_watched(tasks)))
    return _guarded(results, parallel)


def _watched(tasks: Iterable[Task]) -> Iterator[Task]:
    """Tasks whose processes end with this one, for which they work."""
    end_what_begins_with_this_process()
    for task in tasks:
        yield delayed(_in_worker)(os.getpid(), *task)


def end_what_begins_with_this_process() -> None:
    """Have processes that do not run yet look after this one before they ask for tasks.

    The half of a task that was sent by a process killed meanwhile is waited for without
    an end. Joblib asks for its first task when it has an executor and no process.
    """
    executor = reusable_executor._executor
    if executor is not None and executor._initializer is None:
        executor._initializer, executor._initargs = end_with_parent, (os.getpid(),)


@cache
def give_way() -> None:
    """Have the process of a task work in the background from now on.

    The one that it works for goes on with other things, which else would be last.
    """
    if _is_worker() and hasattr(os, "nice"):
        os.nice(_NICE)


def _is_worker() -> bool:
    return multiprocessing.current_process().name.startswith("LokyProcess")


def started(n_jobs: int | None) -> Callable[[], None]:
    """Have `n_jobs` processes import what work takes while this one does other things.

    What is returned waits for them.
    """
    n_jobs = check_jobs(n_jobs)
    most = max(effective_n_jobs(-1), cpu_count())
    n_workers = min(effective_n_jobs(n_jobs), most)
    ready = results_of([delayed(_ready)()] * n_workers, n_jobs)

    def wait() -> None:
        for _ in ready:
            pass

    return wait


def _ready() -> None:
    """With this module a process imports the library, here what SciPy puts off."""
    import_module("scipy.signal")


@contextmanager
def _broken_pools_told() -> Iterator[None]:
    """Say why a pool is broken, and what to do about it."""
    try:
        yield
    except BrokenProcessPool as error:
        cause = error.__cause__  # the traceback of a worker that lives, its last line
        if "task has failed to un-serialize" not in str(error) or cause is None:
            raise RuntimeError(_KILLED) from error
        last = str(cause).strip(' \n"').splitlines()[-1]
        raise RuntimeError(_UNREADABLE.format(cause=last)) from error


def _guarded(results: Iterator[Any], parallel: Parallel) -> Iterator[Any]:
    done = threading.Event()
    for watch, of in ((_watch_workers, ()), (_watch_tasks, (parallel,))):
        threading.Thread(target=watch, args=(done, *of), daemon=True).start()
    try:
        with _broken_pools_told():
            yield from results
    except MemoryError as error:
        raise MemoryError(
            f"The work takes more memory than there is ({error}). Take fewer `n_jobs`, "
            "as each holds its own copy of what it works on."
        ) from error
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
    while results is not None and not done.wait(WATCH):
        workers = list(executor._processes.values())
        dead = any(not worker.is_alive() for worker in workers)
        if dead and seen_dead and executor._flags.broken is None:
            for worker in workers:
                worker.terminate()
            results._writer.close()
            return
        seen_dead = dead


def _watch_tasks(done: threading.Event, parallel: Parallel) -> None:
    """Have joblib raise what a cluster itself says of a task, as of one it cannot read.

    It waits for ever for one of dask that fails before its function is called.
    """
    while not done.wait(WATCH):
        for task in list(parallel._jobs):
            sent = task.job
            if isinstance(sent, Future) and sent.done() and sent.exception():
                task._register_outcome(dict(status="Error", result=sent.exception()))


def _in_worker(
    asked_by: int,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> Any:
    if _is_worker():
        within = asked_by == os.getpid()  # a fit of a search, say
        end_with_parent(os.getppid() if within else asked_by)
        _freeze_modules()
    return function(*args, **kwargs)


@cache
def _freeze_modules() -> None:
    """An end that looks for cycles in them takes a quarter of a second.

    The other process waits for it.
    """
    gc.freeze()
