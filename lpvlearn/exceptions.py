"""Warnings that the estimators of this library raise."""

from __future__ import annotations


class ExtrapolationWarning(UserWarning):
    """A model was evaluated outside the scheduling range it was identified on."""


class RankWarning(UserWarning):
    """The data do not determine the model: a minimum-norm solution was taken."""
