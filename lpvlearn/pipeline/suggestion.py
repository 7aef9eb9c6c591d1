"""Where to measure next: the operating point that would tell most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from ..data.operating_points import neighbours
from ..lpv.left_out import interpolated_without
from ..lpv.weighting import covariance_factor
from ..metrics.table_simulation import unwrapped
from ..models.gap import gap
from ..models.statespace import DEVIATION, StateSpace, scaled
from ..systems.least_squares import row_and_column_scales
from ..validation import one_of
from .estimator import LocalLPVPipeline

Array = NDArray[np.float64]

_CRITERIA = ("uncertainty", "neighbour_gap")


def suggest_operating_point(
    pipeline: LocalLPVPipeline, *, criterion: str = "uncertainty"
) -> pd.DataFrame:
    """Candidates for the next local experiment, the most useful first.

    Candidates are the middles between neighbouring operating points: of one scheduling
    variable, between one point and the next; of several, of the edges of a Delaunay
    triangulation. Distances between frozen models are nu-gaps (`gap`), with inputs and
    outputs in units in which the gains of the local models are about 1: they are
    between 0 and 1, and what a controller feels.

    Parameters
    ----------
    pipeline : LocalLPVPipeline
        Fitted, with two operating points at least.
    criterion : {"uncertainty", "neighbour_gap"}, default="uncertainty"
        The column to rank by; the other one where that is not known.

    Returns
    -------
    DataFrame
        A row per candidate, with the columns

        - the scheduling variables, by their names;
        - "from", "to": numbers of the neighbours, rows of `operating_points_`;
        - "neighbour_gap": from the model of one neighbour to that of the other. Large
          where the dynamics change much from point to point;
        - "leave_one_out": how far the interpolated model moves when operating points
          are left out in turn (the jackknife's standard deviation). Large where the
          interpolation hangs on few points, or its form is not true;
        - "noise": standard deviation of the interpolated model by the covariances of
          the parameters, to first order; NaN where these are not known;
        - "uncertainty": the larger of the two.

        A difference in delays does not count.

    Raises
    ------
    ValueError
        If the pipeline is not fitted, or has one operating point only.

    References
    ----------
    J. P. C. Kleijnen, W. C. M. van Beers, Application-driven sequential designs for
    simulation experiments. Journal of the Operational Research Society 55, 2004: the
    jackknife at candidates between points chooses the next one.

    Examples
    --------
    A spring measured closely at small values of the scheduling variable:

    >>> import numpy as np
    >>> from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, LocalLPVPipeline
    >>> from lpvlearn import from_trajectories, suggest_operating_point
    >>> spring = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]])
    >>> u = np.sign(np.random.default_rng(0).standard_normal(400))
    >>> X, y = from_trajectories(
    ...     [(u, kappa, spring.model({"k": 4 * np.exp(kappa), "c": 1}).simulate(
    ...         u, sampling_time=0.1)) for kappa in (0, .2, .4, 1)], sampling_time=0.1)
    >>> pipeline = LocalLPVPipeline(
    ...     restructurer=GrayBoxRestructurer(spring),
    ...     scheduling="kappa", experiment="experiment", time="time").fit(X, y)
    >>> table = suggest_operating_point(pipeline)
    >>> float(table["kappa"].iloc[0])
    0.7
    """
    one_of("criterion", criterion, _CRITERIA)
    pipeline = unwrapped(pipeline)
    if not isinstance(pipeline, LocalLPVPipeline):
        raise ValueError(
            "`pipeline` must be a fitted LocalLPVPipeline. Got "
            f"{type(pipeline).__name__}."
        )
    check_is_fitted(pipeline, "lpv_")
    kappa = pipeline.operating_points_
    if len(kappa) < 2 or not np.ptp(kappa, axis=0).any():
        raise ValueError(
            "`suggest_operating_point` looks between operating points and needs two at "
            f"least. Got {len(kappa)}. Measure at the ends of the range first."
        )
    pairs = neighbours(kappa)
    places = kappa[pairs].mean(axis=1)
    local = [model.with_input_delay(0) for model in pipeline.structured_models_]
    y, u = _units(local)

    def distance(one: StateSpace, other: StateSpace) -> float:
        return gap(scaled(one, 1.0 / u, y), scaled(other, 1.0 / u, y))

    structure, theta = pipeline.lpv_.structure, pipeline.lpv_.parameters(places)
    frozen = [structure.model(values) for values in theta]

    def interpolated(out: NDArray[np.bool_]) -> list[StateSpace]:
        """At the candidates, of the points themselves, refined or not."""
        form, parameters = pipeline.interpolator_, pipeline.parameters_.to_numpy()
        known = pipeline.parameters_covariance_
        values = interpolated_without(out, form, kappa, parameters, places, known)
        return [] if values is None else [structure.model(v) for v in values]

    left_out = np.full((len(kappa), len(places)), np.nan)
    of_all = interpolated(np.zeros(len(kappa), bool))
    for i in range(len(kappa)):
        without = interpolated(np.arange(len(kappa)) == i)
        for k, pair in enumerate(zip(without, of_all, strict=False)):  # or of none
            left_out[i, k] = distance(*pair)
    noise = np.full(len(places), np.nan)
    known = pipeline.lpv_.covariance is not None
    none: Any = []
    deviations = pipeline.lpv_.parameter_deviations(places) if known else none
    for k, root in enumerate(deviations):
        squares = 0.0
        for direction in covariance_factor(root @ root.T).T:
            moved = structure.model(theta[k] + DEVIATION * direction)
            squares += (distance(moved, frozen[k]) / DEVIATION) ** 2
        noise[k] = np.sqrt(squares)

    n_folds = np.isfinite(left_out).any(axis=1).sum()
    share = (n_folds - 1) / n_folds if n_folds else np.nan
    jackknife = np.sqrt(share * np.nansum(left_out**2, axis=0))
    columns: dict[Any, Any] = dict(
        zip(pipeline.scheduling_names_, places.T, strict=True)
    )
    columns |= {
        "from": pairs[:, 0],
        "to": pairs[:, 1],
        "neighbour_gap": [distance(local[i], local[j]) for i, j in pairs],
        "leave_one_out": jackknife,
        "noise": noise,
        "uncertainty": np.fmax(jackknife, noise),
    }
    other = next(name for name in _CRITERIA if name != criterion)
    table = pd.DataFrame(columns).sort_values([criterion, other], ascending=False)
    return table.reset_index(drop=True)


def _units(models: Sequence[StateSpace]) -> tuple[Array, Array]:
    """Units of outputs and inputs in which gains near the poles are about one."""
    omega = np.unique(np.abs(np.concatenate([model.poles() for model in models])))
    omega = omega[omega > 0] if (omega > 0).any() else np.ones(1)
    gains = np.abs([model.frequency_response(omega) for model in models])
    largest = np.where(np.isfinite(gains), gains, 0.0).max(axis=(0, 1))
    return row_and_column_scales(largest[None])
