"""Local linear parameter-varying (LPV) identification."""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
else:

    def __getattr__(name: str) -> Any:
        """A public name, or a room, which is entered when somebody asks for it.

        So `import lpvlearn` costs next to nothing, and a model no estimators.
        """
        if name in _ROOMS:
            return import_module("." + name, __name__)
        for room in _ROOMS if name in __all__ else ():
            module = import_module("." + room, __name__)
            if name in getattr(module, "__all__", ()):
                return globals().setdefault(name, getattr(module, name))
        return object.__getattribute__(sys.modules[__name__], name)  # refuses it

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


__version__ = "0.1.0"

# From the ground up, the public names stand in these.
_ROOMS = (
    "exceptions",
    "validation",
    "minimax",
    "systems",
    "models",
    "data",
    "structures",
    "subspace",
    "metrics",
    "lpv",
    "restructuring",
    "inspection",
    "pipeline",
)

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
