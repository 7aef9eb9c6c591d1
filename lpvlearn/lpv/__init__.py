"""Step 5 of the method: parameters over the scheduling variables; the LPV model."""

from .auto import AutoLPV
from .coefficients import MatrixCoefficients
from .lfr import LinearFractionalModel
from .model import LPVStateSpace
from .polynomial import PolynomialLPV
from .rational import RationalLPV
from .spline import SplineLPV

__all__ = [
    "AutoLPV",
    "LPVStateSpace",
    "LinearFractionalModel",
    "MatrixCoefficients",
    "PolynomialLPV",
    "RationalLPV",
    "SplineLPV",
]
