"""Local linear parameter-varying (LPV) identification."""

from .data import (
    BlockedTimeSeriesSplit,
    ExperimentSplit,
    from_trajectories,
    resample,
    split_levels,
)
from .lpv import AutoLPV, LPVStateSpace, PolynomialLPV, RationalLPV, SplineLPV
from .metrics import (
    bft_score,
    bft_scorer,
    compare_models,
    fit_report,
    make_bft_scorer,
    make_vaf_scorer,
    parameter_fit,
    readable_report,
    vaf_score,
    vaf_scorer,
)
from .models import InnovationModel, StateSpace, gap, peak_gains
from .pipeline import (
    LocalLPVPipeline,
    OutputErrorLPV,
    load,
    save,
    suggest_operating_point,
)
from .restructuring import GrayBoxRestructurer
from .structures import GrayBoxStructure
from .subspace import SubspaceLTI

__version__ = "0.1.0"

__all__ = [
    "AutoLPV",
    "BlockedTimeSeriesSplit",
    "ExperimentSplit",
    "GrayBoxRestructurer",
    "GrayBoxStructure",
    "InnovationModel",
    "LPVStateSpace",
    "LocalLPVPipeline",
    "OutputErrorLPV",
    "PolynomialLPV",
    "RationalLPV",
    "SplineLPV",
    "StateSpace",
    "SubspaceLTI",
    "bft_score",
    "bft_scorer",
    "compare_models",
    "fit_report",
    "from_trajectories",
    "gap",
    "load",
    "make_bft_scorer",
    "make_vaf_scorer",
    "parameter_fit",
    "peak_gains",
    "readable_report",
    "resample",
    "save",
    "split_levels",
    "suggest_operating_point",
    "vaf_score",
    "vaf_scorer",
]
