"""The built-in flexible arm: simulator and experiments; stored data sets."""

from ._excitation import prbs
from ._flexible_arm import FlexibleArm
from ._generator import make_flexible_arm
from ._reference import load_flexible_arm, load_varying_spring
from ._response import ArmResponse

__all__ = [
    "ArmResponse",
    "FlexibleArm",
    "load_flexible_arm",
    "load_varying_spring",
    "make_flexible_arm",
    "prbs",
]
