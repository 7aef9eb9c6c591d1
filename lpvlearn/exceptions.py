"""Warnings that this library gives, and the one way to give them."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

_HERE = str(Path(__file__).parent) + os.sep


class ExtrapolationWarning(UserWarning):
    """A model was evaluated outside the scheduling range it was identified on."""


class RankWarning(UserWarning):
    """The data do not determine the model: a minimum-norm solution was taken."""


class Told(NamedTuple):
    """A warning that was not given yet."""

    message: str
    category: type[Warning]


_COLLECTING: ContextVar[list[Told] | None] = ContextVar("collecting", default=None)


@contextmanager
def collected() -> Iterator[list[Told]]:
    """Collect what the block warns of by `warn`, instead of giving the warnings.

    In this thread alone, where the filters of `warnings` are those of all threads.
    """
    told: list[Told] = []
    token = _COLLECTING.set(told)
    try:
        yield told
    finally:
        _COLLECTING.reset(token)


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Give a warning that points to the user's line, however deep it arises.

    That line is the one which called the outermost function of this library: what
    lies between (joblib, a pipeline of scikit-learn) is passed over.
    """
    collecting = _COLLECTING.get()
    if collecting is not None:
        collecting.append(Told(message, category))
        return
    level, frame = 1, sys._getframe(1)
    outermost = 1
    while frame.f_back is not None:
        if frame.f_code.co_filename.startswith(_HERE):
            outermost = level
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=outermost + 2)
