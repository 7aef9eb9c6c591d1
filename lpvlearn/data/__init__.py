"""Tables of experiments: columns and their roles, time, operating points, gaps."""

from .experiments import from_trajectories

__all__ = ["from_trajectories"]
