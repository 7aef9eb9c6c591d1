"""Built-in systems, the flexible arm and the unbalanced disc; stored data sets."""

from .excitation import prbs
from .flexible_arm import ArmResponse, FlexibleArm
from .generator import make_flexible_arm
from .reference import data_folder, load_flexible_arm, load_varying_spring
from .unbalanced_disc import UnbalancedDisc, make_unbalanced_disc

__all__ = [
    "ArmResponse",
    "FlexibleArm",
    "UnbalancedDisc",
    "data_folder",
    "load_flexible_arm",
    "load_varying_spring",
    "make_flexible_arm",
    "make_unbalanced_disc",
    "prbs",
]
