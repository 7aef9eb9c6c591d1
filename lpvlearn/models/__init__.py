"""Linear time-invariant models: state space, innovation form, norms, distances."""

from .gap import gap
from .innovation import InnovationModel, NoiseModel
from .peak_gains import PeakGains, peak_gains
from .statespace import StateSpace

__all__ = [
    "InnovationModel",
    "NoiseModel",
    "PeakGains",
    "StateSpace",
    "gap",
    "peak_gains",
]
