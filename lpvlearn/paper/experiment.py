"""The paper's experiment (Section 3), done by this library.

Local experiments on the flexible arm at seven operating points, a Monte Carlo of noise
realizations, local models, restructuring, interpolation, and validation on a sweep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from joblib import Memory
from numpy.typing import NDArray
from sklearn.utils import Bunch

from .. import (
    AutoLPV,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
)
from ..datasets import make_flexible_arm
from ..pipeline.one_basis.black_boxes import balanced_entries
from ..pipeline.points.local_models import experiments_of, unheard_model
from ..pipeline.running.runner import PointRunner
from ..pipeline.running.stopwatch import Stopwatch
from ..pipeline.running.workers import give_way, started
from .tables import (
    ParameterSet,
    interpolation_table,
    local_table,
    nearest_model,
    restructuring_table,
    sweeps_table,
    validation_table,
)

Array = NDArray[np.float64]


# What the paper does: the simulation error of a record that starts at rest about zero.
_LOCAL: dict[str, Any] = {"feedthrough": False, "refine": "simulation", "offset": None}


@dataclass(frozen=True)
class PaperExperiment:
    """Everything that the paper's experiment produced.

    Attributes
    ----------
    data : Bunch
        From `make_flexible_arm`.
    pipeline : LocalLPVPipeline
        The method, fitted.
    parameters : dict of str to ParameterSet
        "restructured", "analytic" and "balanced".
    lpv : dict of str to LPVStateSpace
        Interpolated with the requested degree.
    tables : dict of str to DataFrame
        "table1", "table1_other", "table2", "table3", "table4", "momentum", "timing".
    degree, n_realizations : int
        Of the interpolation; of the noise at each operating point.
    method, other_method : str
        Subspace methods of `pipeline` and of "table1_other".
    watch : Stopwatch
        Seconds of the steps, one after the other.
    """

    data: Bunch
    pipeline: LocalLPVPipeline
    parameters: dict[str, ParameterSet]
    lpv: dict[str, LPVStateSpace]
    tables: dict[str, pd.DataFrame]
    degree: int
    n_realizations: int
    method: str
    other_method: str
    watch: Stopwatch


def run_paper_experiment(
    n_realizations: int = 100,
    degree: int = 2,
    *,
    method: str = "po-moesp",
    random_state: int = 0,
    n_jobs: int | None = None,
    memory: Any = None,
    verbose: int = 0,
    meanwhile: Callable[[PaperExperiment], object] | None = None,
) -> PaperExperiment:
    """Run the protocol of Section 3 and tabulate it beside the published figures.

    Parameters
    ----------
    n_realizations : int, default=100
        Noise realizations at each operating point, at 30 dB.
    degree : int, default=2
        Degree of the interpolation in Table 4.
    method : {"po-moesp", "pi-moesp"}, default="po-moesp"
        Subspace method of the local models; the other one is tabulated as well.
    random_state : int, default=0
    n_jobs : int, default=None
    memory : path, default=None
        Folder that keeps the operating points done, as of `LocalLPVPipeline`.
    verbose : int, default=0
        1 shows progress bars, and lines of other steps that take long.
    meanwhile : function, default=None
        Called with the experiment, without "table1_other", while other processes
        (`n_jobs`) are at work on that.

    Returns
    -------
    PaperExperiment
    """
    watch = Stopwatch(verbose=verbose)
    ready = started(n_jobs)
    with watch.step("simulation of the arm"):
        data = make_flexible_arm(
            n_realizations=n_realizations, random_state=random_state
        )
    roles: dict[str, Any] = {
        "scheduling": "kappa",
        "experiment": "experiment",
        "time": "time",
        "combine": "average",
        "efficient": False,  # the paper's H-infinity optimum
        "n_jobs": n_jobs,
        "memory": memory,
        "verbose": verbose,
    }
    pipeline = LocalLPVPipeline(
        SubspaceLTI(method=method, **_LOCAL),
        GrayBoxRestructurer(data.structure),
        PolynomialLPV(degree),
        **roles,
    ).fit(data.X, data.y)
    ready()
    watch.seconds |= pipeline.step_times_
    other = "pi-moesp" if method == "po-moesp" else "po-moesp"
    runner = PointRunner(n_jobs, verbose, "raise", Memory(memory, verbose=0))
    compared = runner.start(
        f"local models by {other}",
        _compared,
        [
            (SubspaceLTI(data.structure.order, method=other, **_LOCAL), runs)
            for runs in _experiments(data)
        ],
        data.operating_points[:, None],
        sampling_time=data.sampling_time,
        combine=roles["combine"],
        discretization="zoh",
    )
    with watch.step("validation"):
        kappa = pipeline.operating_points_
        analytic = [data.arm.parameters(np.arccos(k)) for k in kappa[:, 0]]
        own = pipeline.parameters_.to_numpy()
        parameters = {
            "restructured": ParameterSet(data.structure, own),
            "analytic": ParameterSet(data.structure, np.array(analytic)),
            "balanced": ParameterSet(*balanced_entries(pipeline.local_models_)),
        }
        lpv = {
            name: _interpolated(found, kappa, degree)
            for name, found in parameters.items()
        }
        models = [nearest_model(pipeline, k) for k in data.operating_points]
        tables = {
            "table1": local_table(models, data),
            "table2": restructuring_table(pipeline, data),
            "table3": interpolation_table(parameters, kappa),
            "table4": validation_table(lpv, data),
            "momentum": sweeps_table(_of_momenta(pipeline, data), data),
        }
    experiment = PaperExperiment(
        data,
        pipeline,
        parameters,
        lpv,
        tables,
        degree,
        n_realizations,
        method,
        other,
        watch,
    )
    if meanwhile is not None:
        meanwhile(experiment)
    waiting = f"local models by {other}, beyond the time of the two before"
    with watch.step(waiting, bar=True):
        comparison = [done.result for done in compared() if done is not None]
    tables["table1_other"] = local_table(comparison, data)
    tables["timing"] = watch.table()
    return experiment


def _experiments(data: Bunch) -> list[Any]:
    """The experiments at every angle."""
    n_samples = np.count_nonzero(data.X["experiment"] == 0)
    shape = (len(data.theta2), -1, n_samples, 2)
    u, y = data.X[["u1", "u2"]].to_numpy(), data.y.to_numpy()
    return [
        experiments_of(*pair, data.sampling_time)
        for pair in zip(u.reshape(shape), y.reshape(shape), strict=True)
    ]


def _compared(local: SubspaceLTI, experiments: Any, **options: Any) -> StateSpace:
    """The local model of a point by the other method, while this one goes on."""
    give_way()
    return unheard_model(local, experiments, **options)


def _interpolated(found: ParameterSet, kappa: Array, degree: int) -> LPVStateSpace:
    """The LPV model through parameters at the operating points, Eq. (35)."""
    interpolator = PolynomialLPV(degree).fit(kappa, found.theta)
    return LPVStateSpace(
        found.structure, interpolator, np.array([kappa.min(0), kappa.max(0)])
    )


def _of_momenta(pipeline: LocalLPVPipeline, data: Bunch) -> LPVStateSpace:
    """The same local models, interpolated in the momenta and by the form they choose.

    Parameters of the arm are those of either state.
    """
    kappa = pipeline.operating_points_
    form = AutoLPV().fit(
        kappa, pipeline.parameters_, covariance=pipeline.parameters_covariance_
    )
    return LPVStateSpace(
        data.arm.structure("momentum"), form, np.array([kappa.min(0), kappa.max(0)])
    )
