"""The whole method on one table: the steps in order, over all operating points."""

from .estimator import LocalLPVPipeline
from .suggestion import suggest_operating_point

__all__ = ["LocalLPVPipeline", "suggest_operating_point"]
