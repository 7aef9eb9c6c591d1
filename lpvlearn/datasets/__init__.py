"""The built-in flexible arm: simulator, generator of experiments, reference data."""

from ._excitation import prbs
from ._flexible_arm import FlexibleArm
from ._generator import make_flexible_arm
from ._reference import load_flexible_arm
from ._response import ArmResponse

__all__ = [
    "ArmResponse",
    "FlexibleArm",
    "load_flexible_arm",
    "make_flexible_arm",
    "prbs",
]
