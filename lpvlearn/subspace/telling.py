"""How a fit tells the user of things: each kind once, channels by their names."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import dataclass, field
from operator import index
from typing import Self, SupportsIndex

from ..exceptions import warn

# Kinds of warnings of samples that are none of the system's: what else may be told of a
# model that was made of them comes of that.
SPOILING = frozenset({"codes", "dropouts", "lines", "bursts", "wraps", "exchanged"})

_UNHEARD: ContextVar[bool] = ContextVar("unheard", default=False)


@contextmanager
def unheard() -> Iterator[None]:
    """Have the fits of the block, in this thread, tell nothing."""
    token = _UNHEARD.set(True)
    try:
        yield
    finally:
        _UNHEARD.reset(token)


@dataclass
class Telling:
    """What was told, and how the columns of inputs and outputs are called.

    Channels without names (None) are numbered, counted from 1. Where nobody is to hear
    it (`silent`) what only tells need not be computed.
    """

    inputs: Sequence[Hashable] | None = None
    outputs: Sequence[Hashable] | None = None
    kinds: set[str] = field(default_factory=set)  # of warnings that were given
    silent: bool = field(default_factory=_UNHEARD.get)
    spoilt: bool = False  # whether something of a `SPOILING` kind was told

    def __contains__(self, kind: str) -> bool:
        return kind in self.kinds

    def once(
        self, kind: str, message: str, category: type[Warning] = UserWarning
    ) -> None:
        """Warn of a kind of thing that was not told before; from now on it was."""
        if kind not in self:
            self.kinds.add(kind)
            self.spoilt |= kind in SPOILING
            warn(message, category, kind)

    def aside(self, *silent: str) -> Self:
        """What tells the same but of these kinds, and is not remembered here."""
        other = copy(self)
        other.kinds = self.kinds | set(silent)
        return other

    def input(self, k: SupportsIndex) -> str:
        """How a message calls the input in column `k`."""
        return _called(self.inputs, k)

    def output(self, k: SupportsIndex) -> str:
        """How a message calls the output in column `k`."""
        return _called(self.outputs, k)


def in_experiment(sample: object, experiment: int, n_experiments: int) -> str:
    """How a message calls a sample, or several: of which experiment, if of some.

    >>> in_experiment(7, 0, 1), in_experiment("7, 9", 2, 3)
    ('7', '7, 9 of experiment 2')
    """
    return f"{sample} of experiment {experiment}" if n_experiments > 1 else f"{sample}"


def _called(names: Sequence[Hashable] | None, k: SupportsIndex) -> str:
    return str(index(k) + 1) if names is None else repr(names[index(k)])
