"""One call from input-output records to a discrete-time state-space model.

Scaling, compression, subspace, shift invariance, simulation least squares and the
refinement in sequence: the function core of `lpvlearn.subspace.SubspaceLTI`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .hankel import correlation_sequence, data_factor
from .realization import (
    ObservabilitySubspace,
    dominant_pair,
    observability_subspace,
    reflect_unstable,
    shift_invariant_pair,
)
from .refinement import refine_simulation
from .signals import Record, output_energy
from .simulation_fit import Freedom, Realization, freedom, simulation_fit

Array = NDArray[np.float64]

# A reflected (stable) start is preferred unless its loss is larger by this factor, one
# per cent, and by more than growing states explain of the last samples' noise: this
# many times what the parameters of a model absorb of it.
STABLE_LOSS = 1.01

_BY_CHANCE = 10.0

# Enforced stability keeps this distance from the unit circle, where rounding could
# bring a pole back.
STABLE_MARGIN = 1e-8


class ScaledRecords(NamedTuple):
    """Records with every channel scaled to unit root mean square.

    Attributes
    ----------
    records : list of Record
    input_scale : ndarray of shape (n_inputs,)
    output_scale : ndarray of shape (n_outputs,)
    """

    records: list[Record]
    input_scale: Array
    output_scale: Array


class Settings(NamedTuple):
    """How models are made of scaled records.

    Attributes
    ----------
    free : Freedom
    method, refine, enforce_stability, n_noise_states
        As in `identify`.
    """

    free: Freedom
    method: str = "po-moesp"
    refine: bool = True
    enforce_stability: bool = False
    n_noise_states: int = 0

    def max_order(self, horizon: int) -> int:
        """Highest order that a horizon can show of these channels."""
        n_outputs, n_inputs = self.free.direct.shape
        return max_order(horizon, n_inputs, n_outputs, self.method)


class Identified(NamedTuple):
    """Result of `identify`.

    Attributes
    ----------
    A, B, C, D : ndarray
        Discrete-time model in the units of the data.
    initial_states : ndarray of shape (n_experiments, order)
    singular_values : ndarray of shape (horizon * n_outputs,)
        Of the subspace the order was read from.
    residual : float
        Root mean square of the simulation errors on the data, relative to that of
        the outputs (all outputs, each scaled).
    rank_deficit : int
        Directions of B and D that the data leave undetermined.
    n_iter : int
        Refinement steps taken.
    scaled_model : Realization
        The model of the scaled records.
    input_scale, output_scale : ndarray
        Units of the channels in it.
    stability_loss : float
        Increase of `residual` that enforced stability cost.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    initial_states: Array
    singular_values: Array
    residual: float
    rank_deficit: int
    n_iter: int
    scaled_model: Realization
    input_scale: Array
    output_scale: Array
    stability_loss: float = 0.0


def _root_mean_square(parts: Sequence[Array]) -> Array:
    """RMS of every column over all parts, safe against under- and overflow; 1 for 0."""
    peak = np.max([np.abs(part).max(axis=0) for part in parts], axis=0)
    peak[peak == 0.0] = 1.0
    energy = sum(((part / peak) ** 2).sum(axis=0) for part in parts)
    rms = peak * np.sqrt(energy / sum(len(part) for part in parts))
    rms[rms == 0.0] = 1.0
    return rms


def scale_records(experiments: Sequence[tuple[Array, Array]]) -> ScaledRecords:
    """Scale inputs and outputs of all experiments together.

    Parameters
    ----------
    experiments : sequence of (u, y)
        Shapes (n_samples, n_inputs) and (n_samples, n_outputs).
    """
    su = _root_mean_square([u for u, _ in experiments])
    sy = _root_mean_square([y for _, y in experiments])
    records = [
        Record(np.ascontiguousarray((u / su).T), np.ascontiguousarray((y / sy).T))
        for u, y in experiments
    ]
    return ScaledRecords(records, su, sy)


def max_horizon(lengths: Sequence[int], n_inputs: int, n_outputs: int) -> int:
    """Largest horizon for which the Hankel columns outnumber its rows (at least 1).

    Parameters
    ----------
    lengths : sequence of int
        Samples of every experiment.
    n_inputs, n_outputs : int

    Examples
    --------
    >>> max_horizon([3000], 2, 2)
    300
    """
    rows = 2 * (n_inputs + n_outputs)
    low, high = 1, max(1, max(lengths) // 2)
    while low < high:  # the number of columns falls with the horizon
        middle = (low + high + 1) // 2
        n_columns = sum(max(0, n - 2 * middle + 1) for n in lengths)
        low, high = (middle, high) if n_columns >= rows * middle else (low, middle - 1)
    return low


def max_order(horizon: int, n_inputs: int, n_outputs: int, method: str) -> int:
    """Largest order a horizon can show.

    Shift invariance needs ``(horizon - 1) n_outputs`` rows; PI-MOESP has no more than
    ``horizon * n_inputs`` instruments.

    Examples
    --------
    >>> max_order(4, 1, 2, "po-moesp"), max_order(4, 1, 2, "pi-moesp")
    (6, 4)
    """
    order = (horizon - 1) * n_outputs
    return min(order, horizon * n_inputs) if method == "pi-moesp" else order


def correlations_of(records: Sequence[Record], horizon: int) -> list[Array]:
    """Correlation sequences that serve all horizons up to the one given."""
    return [
        correlation_sequence(z, min(2 * horizon, len(z))) for z in _samples_of(records)
    ]


def _samples_of(records: Sequence[Record]) -> list[Array]:
    """Samples ``[u, y]`` of records, one row per time instant."""
    return [np.ascontiguousarray(np.vstack(record).T) for record in records]


def subspace_of(
    records: Sequence[Record],
    horizon: int,
    highest_order: int,
    *,
    method: str = "po-moesp",
    engine: str = "cholesky",
    correlations: Sequence[Array] | None = None,
) -> ObservabilitySubspace:
    """Compress records and find the observability subspace of every order.

    Parameters
    ----------
    records : sequence of Record
        Scaled.
    horizon, highest_order : int
    method : {"po-moesp", "pi-moesp", "n4sid", "cva"}
    engine : {"cholesky", "qr"}
    correlations : sequence of ndarray, default=None
        From `correlations_of`, to be shared by several horizons.
    """
    m, ny = len(records[0].u), len(records[0].y)
    factor = data_factor(
        _samples_of(records),
        m,
        horizon,
        past_outputs=method != "pi-moesp",
        engine=engine,
        correlations=correlations,
    )
    return observability_subspace(factor, m, ny, horizon, highest_order, method)


def realize(
    subspace: ObservabilitySubspace,
    records: Sequence[Record],
    order: int,
    settings: Settings,
) -> Realization:
    """Model of one order from an observability subspace, not yet refined.

    Poles outside the unit circle are reflected into it where that costs next to
    nothing in simulation error, or always with ``enforce_stability``. With
    ``n_noise_states`` the subspace is read at that much a higher order, and only the
    states that the inputs reach are kept.
    """
    enforce, free = settings.enforce_stability, settings.free
    A, C = _state_pair(subspace, records, order, settings)
    stable_A = reflect_unstable(A, 1.0 - STABLE_MARGIN if enforce else 1.0)
    stable = simulation_fit(stable_A, C, records, free)
    if stable_A is A or enforce:
        return stable
    as_found = simulation_fit(A, C, records, free)
    n_values = sum(record.y.size for record in records)
    n_parameters = order * (len(records[0].u) + len(C) + len(records))
    limit = max(STABLE_LOSS, 1.0 + _BY_CHANCE * n_parameters / n_values)
    return as_found if as_found.loss * limit < stable.loss else stable


def _state_pair(
    subspace: ObservabilitySubspace,
    records: Sequence[Record],
    order: int,
    settings: Settings,
) -> tuple[Array, Array]:
    """A and C, with noise states of those that the inputs reach most."""
    ny = len(records[0].y)
    horizon = len(subspace.singular_values) // ny
    most = min(subspace.basis.shape[1], (horizon - 1) * ny)
    extended = min(order + settings.n_noise_states, most)
    if order == 0 or extended <= order:
        return shift_invariant_pair(subspace.basis, ny, order)
    A, C = shift_invariant_pair(subspace.basis, ny, extended)
    whole = simulation_fit(reflect_unstable(A), C, records, settings.free)
    if not np.isfinite(whole.loss):
        return shift_invariant_pair(subspace.basis, ny, order)
    return dominant_pair(whole.A, whole.B, whole.C, order, horizon)


def estimate(
    subspace: ObservabilitySubspace,
    records: Sequence[Record],
    order: int,
    settings: Settings,
) -> tuple[Realization, int]:
    """As `realize`, then refined where the settings say so; and the steps taken."""
    start = realize(subspace, records, order, settings)
    return (
        refine_simulation(start, records, settings.free)
        if settings.refine
        else (start, 0)
    )


def identify(
    experiments: Sequence[tuple[Array, Array]],
    order: int,
    horizon: int,
    *,
    method: str = "po-moesp",
    feedthrough: bool | NDArray[np.bool_] = True,
    refine: bool = True,
    enforce_stability: bool = False,
    n_noise_states: int = 0,
    initial_states: bool = True,
    engine: str = "cholesky",
    scaled: ScaledRecords | None = None,
) -> Identified:
    """Identify a discrete-time state-space model of given order and horizon.

    Parameters
    ----------
    experiments : sequence of (u, y)
        Arrays (n_samples, n_inputs) and (n_samples, n_outputs); lengths may differ.
        Every experiment has its own initial state.
    order, horizon : int
        Number of states; past and future horizon in samples.
    method : {"po-moesp", "pi-moesp", "n4sid", "cva"}, default="po-moesp"
    feedthrough : bool or ndarray of bool, shape (n_outputs, n_inputs), default=True
        Which entries of D are free; the others are zero.
    refine : bool, default=True
        Gauss-Newton steps on the simulation error after the subspace step.
    enforce_stability : bool, default=False
        Return a stable model whatever it costs.
    n_noise_states : int, default=0
        Additional states of the subspace step, for coloured noise.
    initial_states : bool, default=True
        False starts every experiment from rest.
    engine : {"cholesky", "qr"}, default="cholesky"
        How the data are compressed.
    scaled : ScaledRecords, default=None
        The experiments scaled, where that has been done.

    Examples
    --------
    >>> import numpy as np
    >>> u = np.random.default_rng(0).standard_normal((200, 1))
    >>> y = np.zeros((200, 1))
    >>> for k in range(199):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> model = identify([(u, y)], order=1, horizon=5)
    >>> round(model.A.item(), 9)
    0.8
    """
    scaled = scale_records(experiments) if scaled is None else scaled
    records, su, sy = scaled
    subspace = subspace_of(
        records, horizon, order + n_noise_states, method=method, engine=engine
    )
    free = freedom(len(sy), len(su), feedthrough, initial_states)
    settings = Settings(free, method, refine, False, n_noise_states)
    model, n_iter = estimate(subspace, records, order, settings)
    energy = output_energy(records) or 1.0
    stability_loss, free_loss = 0.0, model.loss
    if enforce_stability and not _radius(model.A) < 1.0 - STABLE_MARGIN:
        stable = settings._replace(enforce_stability=True)
        model, n_iter = estimate(subspace, records, order, stable)
        if 0.0 < free_loss < model.loss:
            stability_loss = np.sqrt(model.loss / energy) - np.sqrt(free_loss / energy)
    return Identified(
        model.A,
        model.B / su,
        sy[:, None] * model.C,
        sy[:, None] * model.D / su,
        model.initial_states,
        subspace.singular_values,
        float(np.sqrt(model.loss / energy)),
        model.rank_deficit,
        n_iter,
        model,
        su,
        sy,
        float(stability_loss),
    )


def _radius(A: Array) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
