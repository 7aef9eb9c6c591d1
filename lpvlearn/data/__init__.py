"""Tables of experiments: roles of columns, time, operating points, gaps, splits."""

from .experiments import from_trajectories
from .levels import split_levels
from .resampling import resample
from .splits import BlockedTimeSeriesSplit, ExperimentSplit

__all__ = [
    "BlockedTimeSeriesSplit",
    "ExperimentSplit",
    "from_trajectories",
    "resample",
    "split_levels",
]
