"""The whole method on one table: the steps in order, over all operating points."""

from .estimator import LocalLPVPipeline
from .model_files.files import load, save
from .output_error import OutputErrorLPV
from .suggestion import suggest_operating_point

__all__ = [
    "LocalLPVPipeline",
    "OutputErrorLPV",
    "load",
    "save",
    "suggest_operating_point",
]
