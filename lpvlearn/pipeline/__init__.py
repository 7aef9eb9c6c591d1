"""The whole method on one table: the steps in order, over all operating points."""

from .estimator import LocalLPVPipeline

__all__ = ["LocalLPVPipeline"]
