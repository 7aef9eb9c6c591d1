"""Linear time-invariant models: state space, innovation form, norms."""

from .innovation import InnovationModel
from .peak_gains import peak_gains
from .statespace import StateSpace

__all__ = ["InnovationModel", "StateSpace", "peak_gains"]
