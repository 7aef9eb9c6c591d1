"""Bounded time: loops that may take long ask whether it is up, and end at their best.

Nothing is interrupted from outside: what a loop has at the end of a step is a result.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter

import numpy as np

_END: ContextVar[float] = ContextVar("end", default=np.inf)  # by `perf_counter`


@contextmanager
def bounded(seconds: float | None) -> Iterator[None]:
    """Give the block that many seconds from now, None for as many as it takes.

    In this thread alone; a block within another one ends with it.

    Examples
    --------
    >>> with bounded(1e-9):
    ...     time_is_up()
    True
    >>> time_is_up()
    False
    """
    end = np.inf if seconds is None else perf_counter() + seconds
    token = _END.set(min(end, _END.get()))
    try:
        yield
    finally:
        _END.reset(token)


def time_is_up() -> bool:
    """Whether the time of the block around has passed; False outside of all blocks."""
    return perf_counter() >= _END.get()
