"""Linear time-invariant models: state space, innovation form, norms."""

from .innovation import InnovationModel, NoiseModel
from .peak_gains import PeakGains, peak_gains
from .statespace import StateSpace

__all__ = ["InnovationModel", "NoiseModel", "PeakGains", "StateSpace", "peak_gains"]
