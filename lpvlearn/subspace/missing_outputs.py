r"""Outputs that are missing, by what the model expects of them.

With the errors v of a simulation described in innovation form, ``x[t+1] = A x[t] + K
e[t]``, ``v[t] = C x[t] + e[t]`` with covariance S of e, the missing ones are expected
where ``sum(e.T inv(S) e)`` is least. A model of the completed samples expects others,
and so forth: the algorithm of expectation and maximisation (A. P. Dempster, N. M. Laird
and D. B. Rubin, "Maximum likelihood from incomplete data via the EM algorithm", Journal
of the Royal Statistical Society B 39, 1977; for dynamic models A. J. Isaksson,
"Identification of ARX-models subject to missing data", IEEE Transactions on Automatic
Control 38, 1993). Where v is white the errors of missing outputs are zero, and the
model that it ends at has the least squares of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..data.experiments import Experiment
from ..data.preparation import complete_runs, part_of
from ..exceptions import warn
from ..models.innovation import InnovationModel
from ..systems.least_squares import scaled_lstsq
from .simulation_error.noise import expected_change, expected_noise, noise_of
from .telling import Telling

Array = NDArray[np.float64]

# The first guess: longest answer to an input in samples, known samples of an output for
# every unknown of it, samples that are looked at.
_LONGEST, _PER_UNKNOWN, _MOST = 100, 20, 20_000

_RCOND = 1e-6  # of its regression: inputs may hardly move

# Pieces by what gaps of the inputs alone leave, and samples of a piece, to be told
_MANY, _SHORT = 5, 50

# Share of an output that is there, below which that is told, and below which the order
# is looked for by what is there alone
_FEW, _SPARSE = 1.0 / 3.0, 0.6

_FURTHEST = 20.0  # steps that several rounds may be taken further

_ROUNDING = 1e-9  # size of an error, relative to those that there are, that is not one


def runs_to_complete(
    experiments: Sequence[Experiment], *, at_rest: bool
) -> list[Experiment]:
    """Runs of samples whose inputs are known, and outputs of some of them.

    What comes before the first output tells nothing of a run, but of one `at_rest`. A
    ValueError where no run is left, an output is never known, or rest is in a gap.
    """
    whole = [run for e in experiments for run in complete_runs(e, 2, outputs=False)]
    if at_rest and len(whole) > len(experiments):
        raise ValueError(
            "`initial_state` must be 'estimate' where inputs are missing, or rows of "
            "the `time` column: what follows a gap does not start from rest. Got "
            "'rest'."
        )
    runs, known = [], []
    for run in whole:
        there = np.isfinite(run.measured)
        at = np.flatnonzero(there.any(axis=1))
        if len(at) > 1:
            runs.append(part_of(run, slice(0 if at_rest else at[0], at[-1] + 1)))
            known.append(there.any(axis=0))
    if not runs or not np.any(known, axis=0).all():
        raise ValueError(
            "missing='estimate' needs some samples of every output beside inputs that "
            "are known. Got none: check X and y for columns that are NaN throughout, "
            "and leave these out."
        )
    return runs


def warn_of_many_pieces(experiments: Sequence[Experiment]) -> None:
    """Tell of a record that missing outputs cut to pieces."""
    pieces = [part for e in experiments for part in complete_runs(e)]
    whole = [run for e in experiments for run in complete_runs(e, outputs=False)]
    n_samples = sum(len(part.rows) for part in pieces)
    many = len(pieces) >= _MANY * max(len(whole), 1)
    if many and n_samples < _SHORT * len(pieces):
        warn(
            f"missing='split' cuts at outputs that are missing: {len(pieces)} pieces "
            f"of {n_samples / len(pieces):.0f} samples in the mean, each with an "
            "initial state of its own, tell little. Use missing='estimate', which cuts "
            "where inputs are missing alone."
        )
        return
    moves = np.array([np.ptp(part.inputs, axis=0).any() for part in pieces])
    if len(pieces) > len(whole) and not moves.all():
        warn(
            "missing='split' cuts at outputs that are missing, and in "
            f"{np.sum(~moves)} of {len(pieces)} pieces no input moves: as each has an "
            "initial state and a constant of its own, these tell nothing of the gain. "
            "Use missing='estimate', which cuts where inputs are missing alone."
        )


def warn_of_few(runs: Sequence[Experiment], telling: Telling) -> None:
    """Tell of an output that is hardly there."""
    known = _shares_known(runs)
    rarest = int(np.argmin(known))
    if known[rarest] < _FEW:
        warn(
            f"Output {telling.output(rarest)} is missing in "
            f"{100.0 * (1.0 - known[rarest]):.0f} % of the samples: so few tell little "
            "of the order, and the model may be far from the system without its bands "
            "(`frequency_response_std`) showing it. Give `order`, record that output "
            "more often, or leave it out."
        )


def is_sparse(runs: Sequence[Experiment]) -> bool:
    """Whether about as many samples of an output are missing as are there.

    What is estimated then decides about an order, and looks like a loop.
    """
    return bool(_shares_known(runs).min() < _SPARSE)


def _shares_known(runs: Sequence[Experiment]) -> Array:
    """Share of every output that is there."""
    there = np.vstack([np.isfinite(run.measured) for run in runs])
    return np.asarray(np.mean(there, axis=0))


def with_estimates(run: Experiment, outputs: Array) -> Experiment:
    """A run with values of outputs that are missing in it."""
    return replace(run, outputs=outputs, estimated=np.isnan(run.measured))


def movement(
    runs: Sequence[Experiment],
    before: Sequence[Experiment],
    after: Sequence[Experiment],
    noise: Array,
) -> float:
    """How far estimates moved, in standard deviations of innovations (their `noise`).

    Root mean square over what is missing in the runs.
    """
    power = np.nanmean(np.vstack([run.measured for run in runs]) ** 2, axis=0)
    variance = np.maximum(np.diagonal(noise), _ROUNDING**2 * power)
    variance[variance == 0.0] = 1.0
    moved = [
        ((new.measured - old.measured) ** 2 / variance)[np.isnan(run.measured)]
        for run, old, new in zip(runs, before, after, strict=True)
    ]
    squares = np.concatenate(moved)
    return float(np.sqrt(np.mean(squares))) if len(squares) else 0.0


def further(
    runs: Sequence[Experiment], rounds: Sequence[Sequence[Experiment]]
) -> list[Experiment]:
    """Estimates where three rounds of one model lead, as far as they go one way.

    Of a map that shortens the way by one factor that is its end (R. Varadhan and C.
    Roland, Scandinavian Journal of Statistics 35, 2008): the more is missing, the
    slower are the rounds.
    """
    first, second, third = ([e.measured for e in one] for one in rounds)
    step = [b - a for a, b in zip(first, second, strict=True)]
    bend = [c - b - s for b, c, s in zip(second, third, step, strict=True)]
    sizes = [np.sqrt(sum(float(np.sum(e**2)) for e in x)) for x in (step, bend)]
    length = min(max(sizes[0] / sizes[1], 1.0), _FURTHEST) if sizes[1] > 0.0 else 1.0
    return [
        with_estimates(run, a + 2.0 * length * s + length**2 * b)
        for run, a, s, b in zip(runs, first, step, bend, strict=True)
    ]


def first_guess(runs: Sequence[Experiment]) -> list[Experiment]:
    """Runs with missing outputs by a moving average of the inputs and its noise.

    >>> u = np.random.default_rng(0).standard_normal((200, 1))
    >>> y = u.copy()
    >>> y[50:60] = np.nan
    >>> (guess,) = first_guess([Experiment("a", np.arange(200), u, y)])
    >>> np.allclose(guess.outputs, u), guess.estimated.sum()
    (True, np.int64(10))
    """
    pairs = [(run.inputs, run.measured) for run in runs]
    centre = np.mean(np.vstack([u for u, _ in pairs]), axis=0)
    pairs = [(u - centre, y) for u, y in pairs]
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    n_known = min(
        sum(np.count_nonzero(~np.isnan(y[:, i])) for _, y in pairs)
        for i in range(n_outputs)
    )
    n_lags = int(np.clip(n_known // (_PER_UNKNOWN * n_inputs), 1, _LONGEST))
    share = min(1.0, _MOST / sum(len(u) for u, _ in pairs))
    heads = [slice(max(1, int(share * len(u)))) for u, _ in pairs]
    parts = list(zip(pairs, heads, strict=True))
    X = np.vstack([_lagged(u[head], n_lags) for (u, _), head in parts])
    Y = np.vstack([y[head] for (_, y), head in parts])
    answers = np.zeros((X.shape[1], n_outputs))
    for i in range(n_outputs):
        known = ~np.isnan(Y[:, i])
        k = _n_regressors(X[known], Y[known, i], n_inputs)
        answers[:k, i] = scaled_lstsq(X[known, :k], Y[known, i], _RCOND)[0]
    return by_simulation(runs, [_lagged(u, n_lags) @ answers for u, _ in pairs])


def _n_regressors(X: Array, y: Array, n_inputs: int) -> int:
    """How many of the first columns have the least value of Schwarz's criterion.

    A constant, and half as many lags again and again.
    """
    factor: Array = linalg.qr(np.column_stack([X, y]), mode="r")[0]
    left = factor[: X.shape[1] + 1, -1] ** 2
    squares = np.cumsum(left[::-1])[::-1]  # that so many columns leave
    n, highest = len(y), X.shape[1]
    floor = _ROUNDING**2 * squares[0] or 1.0
    lags = (highest - 1) // n_inputs
    numbers = {1 + n_inputs * (lags >> k) for k in range(lags.bit_length() + 1)}
    price = np.log(n) / n
    return min(
        sorted(numbers),
        key=lambda k: np.log(max(squares[k:].max(initial=0.0), floor)) + price * k,
    )


def by_simulation(
    runs: Sequence[Experiment], simulated: Sequence[Array]
) -> list[Experiment]:
    """Runs with missing outputs as simulated, and what is expected of the errors."""
    errors = [run.measured - y for run, y in zip(runs, simulated, strict=True)]
    noise = noise_of(errors)
    return [
        with_estimates(
            run, np.where(np.isnan(v), y + expected_noise(noise, v), run.measured)
        )
        for run, y, v in zip(runs, simulated, errors, strict=True)
    ]


def by_prediction(
    run: Experiment, model: InnovationModel, u: Array, x0: Array | None, level: Array
) -> Experiment:
    """A run with missing outputs as a predictor expects them that has a gain.

    Its inputs are `u` about the resting point, its initial state `x0`, and the outputs
    that its answers add to `level`.
    """
    y = run.measured - level
    missing = np.isnan(y)
    y = np.where(missing, model.predict(u, y, initial_state=x0), y)
    innovations = y - model.predict(u, y, initial_state=x0)
    return with_estimates(run, level + y + expected_change(model, innovations, missing))


def _lagged(u: Array, n_lags: int) -> Array:
    """A constant, and the last inputs, zero before the first; a row per sample."""
    n_inputs = u.shape[1]
    out = np.ones((len(u), 1 + n_lags * n_inputs))
    for k in range(n_lags):
        part = out[:, 1 + k * n_inputs : 1 + (k + 1) * n_inputs]
        part[:k], part[k:] = 0.0, u[: max(len(u) - k, 0)]
    return out
