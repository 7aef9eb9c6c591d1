"""Tables of experiments: columns and their roles, time, operating points, gaps."""

from .experiments import from_trajectories
from .resampling import resample

__all__ = ["from_trajectories", "resample"]
