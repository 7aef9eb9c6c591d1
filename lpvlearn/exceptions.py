"""Warnings that this library gives, and the one way to give them."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

_HERE = str(Path(__file__).parent) + os.sep


class ExtrapolationWarning(UserWarning):
    """A model was evaluated outside the scheduling range it was identified on."""


class RankWarning(UserWarning):
    """The data do not determine the model: a minimum-norm solution was taken."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Give a warning that points to the user's line, however deep it arises.

    That line is the one which called the outermost function of this library: what
    lies between (joblib, a pipeline of scikit-learn) is passed over.
    """
    level, frame = 1, sys._getframe(1)
    outermost = 1
    while frame.f_back is not None:
        if frame.f_code.co_filename.startswith(_HERE):
            outermost = level
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=outermost + 2)
