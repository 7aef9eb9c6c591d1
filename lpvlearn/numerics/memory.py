"""Values of expensive functions at the last points at which they were asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray


def remembering(f: Callable[[NDArray], Any], points: int = 4) -> Callable[..., Any]:
    """The function `f` of one array, with its values at the last points remembered.

    Examples
    --------
    >>> import numpy as np
    >>> calls = []
    >>> square = remembering(lambda x: calls.append(x) or x**2)
    >>> square(np.array([2.0])), square(np.array([2.0])), len(calls)
    (array([4.]), array([4.]), 1)
    """
    known: dict[bytes, Any] = {}

    def remembered(x: NDArray) -> Any:
        key = x.tobytes()
        if key not in known:
            value = f(x)
            while len(known) >= points:
                known.pop(next(iter(known)), None)
            known[key] = value
        return known[key]

    return remembered
