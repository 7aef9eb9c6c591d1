"""Step 5 of the method: parameters over the scheduling variables; the LPV model."""

from .model import LPVStateSpace
from .polynomial import PolynomialLPV

__all__ = ["LPVStateSpace", "PolynomialLPV"]
