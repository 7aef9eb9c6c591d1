"""How good a model is: fit measures, scorers, reports, simulation of a table."""

from .reports import compare_models, fit_report, readable_report
from .scorers import (
    TrajectoryScorer,
    bft_scorer,
    make_bft_scorer,
    make_vaf_scorer,
    vaf_scorer,
)
from .scores import bft_score, parameter_fit, vaf_score

__all__ = [
    "TrajectoryScorer",
    "bft_score",
    "bft_scorer",
    "compare_models",
    "fit_report",
    "make_bft_scorer",
    "make_vaf_scorer",
    "parameter_fit",
    "readable_report",
    "vaf_score",
    "vaf_scorer",
]
