"""A horizon that was given, questioned after the fit."""

from __future__ import annotations

import numpy as np

from ...exceptions import warn
from ..fits.local_fit import LocalFit
from ..fits.options import Choices
from ..orders.identification import Settings, fit_once
from ..orders.selection import highest_horizon
from ..samples.hankel import correlation_sequence
from ..samples.records import Record, output_energy
from ..simulation_error.noise import Whitening
from ..simulation_error.simulation_fit import Realization

# What a model at its minimum under white noise does not show: correlation of the
# simulation error with past inputs, in standard deviations (the largest of a hundred
# chance values is near three), or with its predecessor.
_SUSPICIOUS, _SMOOTH = 6.0, 0.3

# Where that is looked for: past inputs up to this many samples ago, in this many
# samples of so many experiments.
_N_LAGS, _MAX_SUSPECTED, _SUSPECTED_RECORDS = 40, 4_096, 4

# Least variance of a correlation, relative to that of white signals: an estimated sum
# of products over the lags may come out as low as zero.
_LEAST_VARIANCE = 0.2

_CLEARLY_BETTER = 0.9  # of the present error: that of a clearly better model
_ROUNDING = 1e-6  # relative errors below it are rounding


def warn_about_horizon(fitted: LocalFit, choices: Choices) -> None:
    """Tell the user when another horizon fits clearly better than the one given."""
    if fitted.method == "pbsid":
        return
    better = _better_horizon(fitted, fitted.settings(choices))
    if better is not None:
        warn(
            f"horizon={choices.horizon} ends in a poor model: its simulation error is "
            f"{100.0 * fitted.residual:.3g} % of the outputs, that of horizon "
            f"{better[0]} is {100.0 * better[1]:.3g} %. Use horizon='auto'."
        )


def _better_horizon(fitted: LocalFit, settings: Settings) -> tuple[int, float] | None:
    """Another horizon whose model fits clearly better, and its residual.

    Others are tried only if the simulation error has structure: coloured noise, a model
    of too low an order, or a poor minimum, which can be told apart by trying.
    """
    model, records = fitted.evidence.model, fitted.scaled.records
    horizon, residual = fitted.selection.horizon, fitted.residual
    if not _ROUNDING < residual < np.inf:
        return None
    some = enumerate(records[:_SUSPECTED_RECORDS])
    structure = [_error_structure(model, record, k) for k, record in some]
    if all(u < _SUSPICIOUS and v < _SMOOTH for u, v in structure):
        return None
    order, energy = len(model.A), output_energy(records)
    highest = highest_horizon(records, settings)
    none = Whitening.none(len(records[0].y))
    # One that minimises other errors is not to blame for those of simulation.
    own = fit_once(records, order, horizon, settings, none)
    residual = min(residual, float(np.sqrt(own.model.loss / energy)))
    for other in (2 * horizon, 4 * horizon, horizon // 2):
        if not 2 <= other <= highest or settings.max_order(other) < order:
            continue
        trial = fit_once(records, order, other, settings, none)
        error = float(np.sqrt(trial.model.loss / energy))
        if error < _CLEARLY_BETTER * residual:
            return other, error
    return None


def _error_structure(
    model: Realization, record: Record, experiment: int
) -> tuple[float, float]:
    """How much the simulation error depends on past inputs and on its own past.

    The largest correlation with past inputs, in standard deviations of an error that
    does not depend on them (Bartlett's formula for two autocorrelated signals), and
    the largest of an output's error with that one sample before.
    """
    n = min(record.n_samples, _MAX_SUSPECTED)
    record, m = record.head(n), len(record.u)
    u, error = record.u.T, record.y.T - model.outputs(record, experiment)
    lags = correlation_sequence(np.hstack([u, error]), min(_N_LAGS, n))
    own = np.einsum("dii->di", lags)
    of_u, of_v = own[:, :m], own[:, m:]
    white = np.outer(of_u[0], of_v[0])
    variance = np.maximum(2.0 * of_u.T @ of_v - white, _LEAST_VARIANCE * white) / n
    variance[variance == 0.0] = np.inf
    by_inputs = (np.abs(lags[:, :m, m:]) / np.sqrt(variance)).max()
    size = np.where(of_v[0] > 0.0, of_v[0], np.inf)
    return float(by_inputs), float((of_v[min(1, len(own) - 1)] / size).max())
