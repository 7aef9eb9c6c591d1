"""How long the steps take, and a line of those that take long."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Timer
from time import perf_counter

import pandas as pd

_PATIENCE = 2.0  # seconds after which one asks oneself what is going on


@dataclass
class Stopwatch:
    """Wall-clock seconds of each step, in the order of the steps.

    With `verbose`, a step without a bar of its own is told once it is long.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    verbose: int = 0

    @contextmanager
    def step(self, name: str, *, bar: bool = False) -> Iterator[None]:
        """Add the time that the block takes to the step."""
        told = Timer(_PATIENCE, print, [f"{name} ..."], {"file": sys.stderr})
        told.daemon = True
        if self.verbose and not bar:
            told.start()
        start = perf_counter()
        try:
            yield
        finally:
            told.cancel()
        self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - start

    def table(self) -> pd.DataFrame:
        """Columns step and seconds, with the total."""
        rows = [*self.seconds.items(), ("total", sum(self.seconds.values()))]
        return pd.DataFrame(rows, columns=["step", "seconds"])
