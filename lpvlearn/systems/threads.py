"""One thread of BLAS while small matrices are worked on.

Between the many small products and factorisations of a fit or a norm, threads of BLAS
wait for each other, spinning: two of them take up to 50 times the processor's time of
one, and more where other programs want the processor, too. Public methods that work on
small matrices for long hold one thread while they run.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar, cast

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])


class _OneBlasThread:
    """One thread of BLAS as long as any thread of the process is within.

    Their number is that of the process: the first one in sets it, and the last one out
    puts it back. A context, and a decorator.
    """

    def __init__(self) -> None:
        self._lock, self._n_within = threading.Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._n_within:
                self._limit = _blas().limit(limits=1, user_api="blas")
                self._limit.__enter__()
            self._n_within += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._n_within -= 1
            if not self._n_within:
                self._limit.__exit__(*error)

    def __call__(self, function: Function) -> Function:
        # Not that of contextlib: a warning's place is the first outside this library
        @wraps(function)
        def within(*args: Any, **options: Any) -> Any:
            with self:
                return function(*args, **options)

        return cast(Function, within)


one_blas_thread = _OneBlasThread()


@cache
def _blas() -> ThreadpoolController:
    """Found once in every process: the search takes longer than a small step."""
    return ThreadpoolController()
