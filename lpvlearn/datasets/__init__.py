"""The built-in flexible arm: simulator and experiments; stored data sets."""

from .excitation import prbs
from .flexible_arm import ArmResponse, FlexibleArm
from .generator import make_flexible_arm
from .reference import load_flexible_arm, load_varying_spring

__all__ = [
    "ArmResponse",
    "FlexibleArm",
    "load_flexible_arm",
    "load_varying_spring",
    "make_flexible_arm",
    "prbs",
]
