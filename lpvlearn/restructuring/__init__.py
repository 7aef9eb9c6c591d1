"""Step 4 of the method: black-box models in the form of a gray-box structure."""

from .estimator import GrayBoxRestructurer

__all__ = ["GrayBoxRestructurer"]
