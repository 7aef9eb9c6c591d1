"""Local linear parameter-varying (LPV) identification."""

from .experiments import from_trajectories
from .innovation_model import InnovationModel
from .interpolation import PolynomialLPV
from .lpv import LPVStateSpace
from .metrics import (
    bft_score,
    bft_scorer,
    fit_report,
    make_bft_scorer,
    make_vaf_scorer,
    parameter_fit,
    vaf_score,
    vaf_scorer,
)
from .model_selection import BlockedTimeSeriesSplit, ExperimentSplit
from .norms import peak_gains
from .pipeline import LocalLPVPipeline
from .reports import compare_models
from .restructuring import GrayBoxRestructurer
from .statespace import StateSpace
from .structures import GrayBoxStructure
from .subspace import SubspaceLTI
from .summary import readable_report

__all__ = [
    "BlockedTimeSeriesSplit",
    "ExperimentSplit",
    "GrayBoxRestructurer",
    "GrayBoxStructure",
    "InnovationModel",
    "LPVStateSpace",
    "LocalLPVPipeline",
    "PolynomialLPV",
    "StateSpace",
    "SubspaceLTI",
    "bft_score",
    "bft_scorer",
    "compare_models",
    "fit_report",
    "from_trajectories",
    "make_bft_scorer",
    "make_vaf_scorer",
    "parameter_fit",
    "peak_gains",
    "readable_report",
    "vaf_score",
    "vaf_scorer",
]
