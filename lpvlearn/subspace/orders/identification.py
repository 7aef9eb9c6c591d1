"""From scaled records to a discrete-time state-space model of given order and horizon.

Compression, subspace, shift invariance, simulation least squares and the refinement in
sequence: the function core of `lpvlearn.subspace.SubspaceLTI`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.modes import n_decays, spectral_radius
from ..samples.hankel import data_factors
from ..samples.records import Record, output_energy, shorten
from ..simulation_error.criterion import criterion_of
from ..simulation_error.held_out import DOUBT, HeldOut, held_out
from ..simulation_error.noise import Whitening
from ..simulation_error.refinement import ROUNDING, refine_simulation
from ..simulation_error.signals import SharedSignals, block_radius, block_sections
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    block_fit,
    simulation_errors,
    simulation_fit,
    with_initial_states,
)
from .realization import (
    ObservabilitySubspace,
    Subspace,
    SubspacesApart,
    observability_subspace,
    reflect_unstable,
)

Array = NDArray[np.float64]

# A reflected (stable) start is preferred unless its loss is larger by this factor, one
# per cent, and by more than growing states explain of the last samples' noise: this
# many times what the parameters of a model absorb of it.
STABLE_LOSS, _BY_CHANCE = 1.01, 10.0

# Enforced stability keeps this distance from the unit circle, where rounding could
# bring a pole back.
STABLE_MARGIN = 1e-8


class Settings(NamedTuple):
    """How models are made of scaled records; the options of `SubspaceLTI`, checked."""

    free: Freedom
    method: str = "po-moesp"
    refine: bool = True
    enforce_stability: bool = False
    n_noise_states: int = 0  # additional states of the subspace step
    weigh: bool = True  # whether errors are weighed by their noise when refined
    compare: bool = True  # whether parts held out may say that other models are better
    # By output the share of errors that repeat those before, as those of rounding do.
    repeated: tuple[float, ...] = ()
    differences: bool = False  # of samples: most of these may be noise
    orders: tuple[int, ...] = ()  # ascending, to choose among; (): all

    def max_horizon(self, lengths: Sequence[int]) -> int:
        """Largest horizon whose Hankel columns outnumber its rows (at least 1).

        `lengths` are the samples of every experiment. Of each output alone where they
        are `too_few` for all together.
        """
        n_outputs, n_inputs = self.free.direct.shape
        n_channels = n_inputs + (1 if self.too_few(lengths) else n_outputs)
        low, high = 1, max(1, max(lengths) // 2)
        while low < high:  # the number of columns falls with the horizon
            middle = (low + high + 1) // 2
            enough = _fill(lengths, middle, n_channels)
            low, high = (middle, high) if enough else (low, middle - 1)
        return low

    def too_few(self, lengths: Sequence[int]) -> bool:
        """Whether samples show states of each output alone, but none of all together.

        That takes a horizon of two.

        >>> settings = Settings(Freedom(np.ones((5, 3), bool)))
        >>> [settings.too_few([n]) for n in (18, 19, 34, 35)]
        [False, True, True, False]
        """
        n_outputs, n_inputs = self.free.direct.shape
        together = _fill(lengths, 2, n_inputs + n_outputs)
        return not together and _fill(lengths, 2, n_inputs + 1)

    def max_order(self, horizon: int) -> int:
        """Largest order that a horizon can show of these channels.

        Shift invariance needs ``(horizon - 1) n_outputs`` rows; PI-MOESP has no more
        than ``horizon * n_inputs`` instruments.
        """
        n_outputs, n_inputs = self.free.direct.shape
        order = (horizon - 1) * n_outputs
        return min(order, horizon * n_inputs) if self.method == "pi-moesp" else order

    def check_size(
        self, lengths: Sequence[int], order: int | None, horizon: int | None
    ) -> None:
        """Refuse a horizon or an order that the number of samples cannot carry.

        Of several orders the lowest must be one of them.

        >>> Settings(Freedom(np.ones((1, 1), bool))).check_size([900], 9, 5)
        Traceback (most recent call last):
        ValueError: `order` must be at most 4 ... horizon 5. Got 9. Use horizon='auto'.
        """
        longest = self.max_horizon(lengths)
        if order is None and self.orders:
            order = self.orders[0]
        if horizon is not None and horizon > longest:
            n_outputs, n_inputs = self.free.direct.shape
            raise ValueError(
                f"`horizon` must be at most {longest} for {sum(lengths)} samples of "
                f"{n_inputs} input(s) and {n_outputs} output(s). Got {horizon}. Use "
                "horizon='auto' or more samples."
            )
        used = longest if horizon is None else horizon
        highest = self.max_order(used)
        if order is not None and order > highest:
            raise ValueError(
                f"`order` must be at most {highest} for {sum(lengths)} samples and "
                f"horizon {used}. Got {order}. "
                + ("Use more samples." if horizon is None else "Use horizon='auto'.")
            )


def _fill(lengths: Sequence[int], horizon: int, n_channels: int) -> bool:
    """Whether Hankel columns outnumber the rows of a horizon."""
    n_columns = sum(max(0, n - 2 * horizon + 1) for n in lengths)
    return n_columns >= 2 * n_channels * horizon


class Candidate(NamedTuple):
    """A model of scaled records, and how it came about."""

    model: Realization
    horizon: int
    whitening: Whitening  # of the errors whose squares it minimises
    refined: bool
    signals: SharedSignals | None = None  # of other records that it is near to
    singular_values: Array = np.zeros(0)  # of its subspace, if that was asked


class Identified(NamedTuple):
    """Result of `identify`."""

    model: Realization  # of the scaled records
    whitening: Whitening  # of the errors whose squares the model minimises
    refined: bool  # whether it does
    singular_values: Array  # (horizon * n_outputs,): of the subspace
    residual: float  # rms of the simulation errors relative to that of all outputs
    stability_loss: float  # increase of the residual that enforced stability cost


def subspaces_of(
    records: Sequence[Record],
    widths: Mapping[int, int],
    settings: Settings,
    *,
    cheap: bool = False,
) -> Mapping[int, Subspace]:
    """Observability subspace of every horizon, of as many directions as given.

    With `cheap` the longer horizons are left out where the samples are so smooth, or so
    free of noise, that many of them are linearly dependent to working precision. Of
    samples that are too few for all outputs together each output has its own.
    """
    method = settings.method
    if max(widths) == 1 or not settings.too_few([r.n_samples for r in records]):
        return _subspaces_of_all(records, widths, method, cheap=cheap)
    of_one = {horizon: horizon - 1 for horizon in widths}
    alone = [
        _subspaces_of_all([r._replace(y=r.y[[i]]) for r in records], of_one, method)
        for i in range(len(records[0].y))
    ]
    return {h: SubspacesApart([spaces[h] for spaces in alone]) for h in widths}


def _subspaces_of_all(
    records: Sequence[Record],
    widths: Mapping[int, int],
    method: str,
    *,
    cheap: bool = False,
) -> dict[int, ObservabilitySubspace]:
    m, ny = len(records[0].u), len(records[0].y)
    samples = [np.ascontiguousarray(np.vstack((r.u, r.y)).T) for r in records]
    past_outputs, n_trend = method != "pi-moesp", len(records[0].trend)
    factors = data_factors(
        samples, m, widths, past_outputs=past_outputs, n_trend=n_trend, cheap=cheap
    )
    found = {}
    for horizon, width in widths.items():
        factor = next(factors)
        if factor is not None:
            space = observability_subspace(factor, m, ny, horizon, width, method)
            found[horizon] = space
        del factor  # none is kept while the next one is made
    return found


def realize(
    subspace: Subspace,
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

    def with_inputs(
        A: Array, C: Array, outputs: Sequence[int]
    ) -> tuple[Array, Array, Array] | None:
        some, freedom = records, free
        if len(outputs) < len(free.direct):
            some = [record._replace(y=record.y[outputs]) for record in records]
            freedom = free._replace(direct=free.direct[outputs])
        whole = simulation_fit(A, C, some, freedom)
        return whole[:3] if np.isfinite(whole.loss) else None

    ny, n_noise = len(records[0].y), settings.n_noise_states
    A, C = subspace.state_pair(ny, order, n_noise, with_inputs)
    limit = 1.0 - STABLE_MARGIN if enforce else 1.0
    sections = block_sections(A)  # which tell of the poles as well
    if sections is not None and block_radius(sections.blocks) <= limit:
        return block_fit(sections.blocks, C @ sections.transform, records, free)
    stable_A = reflect_unstable(A, limit)
    stable = simulation_fit(stable_A, C, records, free)
    if stable_A is A or enforce:
        return stable
    if sections is None:
        as_found = simulation_fit(A, C, records, free)
    else:
        as_found = block_fit(sections.blocks, C @ sections.transform, records, free)
    n_values = sum(record.y.size for record in records)
    n_parameters = order * (len(records[0].u) + len(C) + len(records))
    limit = max(STABLE_LOSS, 1.0 + _BY_CHANCE * n_parameters / n_values)
    rounding = ROUNDING * output_energy(records)  # which poles without effect follow
    return as_found if as_found.loss * limit + rounding < stable.loss else stable


def fit_once(
    records: Sequence[Record],
    order: int,
    horizon: int,
    settings: Settings,
    whitening: Whitening,
    start: Realization | None = None,
    *,
    patient: bool = True,
) -> Candidate:
    """Model of whitened records, from their subspace or another model of them.

    `patient` is as in `refine_simulation`.
    """
    white = whitening.records(records, settings.free)
    width = {horizon: order + settings.n_noise_states}
    subspace = subspaces_of(white, width, settings)[horizon]
    model = realize(subspace, white, order, settings)
    if settings.refine:
        if start is not None:
            other = restarted(start, whitening, white, settings.free)
            if other.loss < model.loss and not settings.enforce_stability:
                model = other
        model = refine_simulation(model, white, settings.free, patient=patient)
    model = of_records(model, records, whitening, settings.free)
    values = subspace.singular_values
    return Candidate(model, horizon, whitening, settings.refine, None, values)


def refit(
    records: Sequence[Record],
    near: Candidate,
    settings: Settings,
    whitening: Whitening,
    *,
    patient: bool = True,
) -> Candidate:
    """As `fit_once`, from a model that is near: the subspace is not asked."""
    free, start = settings.free, near.model
    white = whitening.records(records, free)
    one_each = len(white) == len(start.initial_states) == 1 and not free.n_trend
    if one_each and start.blocks is not None:
        model = whitening.model(start)._replace(loss=np.inf)
        model = refine_simulation(
            model, white, free, fitted=False, patient=patient, signals=near.signals
        )
    else:
        model = restarted(start, whitening, white, free)
        model = refine_simulation(model, white, free, patient=patient)
    model = of_records(model, records, whitening, free)
    return Candidate(model, near.horizon, whitening, True)


def of_records(
    model: Realization,
    records: Sequence[Record],
    whitening: Whitening,
    free: Freedom,
) -> Realization:
    """What a model of whitened records is of the records themselves."""
    if whitening.is_none:
        return model
    model = whitening.undone(model)
    return with_initial_states(model, records, free, whitening.weight)


def restarted(
    model: Realization, whitening: Whitening, white: Sequence[Record], free: Freedom
) -> Realization:
    """The dynamics of a model with the B, D and own unknowns of whitened records."""
    return simulation_fit(model.A, whitening.model(model).C, white, free)


REFITS = 12  # steps to the minimum without some samples, from that with them


def _refitted(
    candidate: Candidate, records: Sequence[Record], settings: Settings
) -> Realization:
    """The model that other records would have given, by few steps from this one."""
    whitening, free = candidate.whitening, settings.free
    white = whitening.records(records, free)
    if not white:
        return candidate.model
    lengths, order = [r.n_samples for r in white], len(candidate.model.A)
    short = settings.max_horizon(lengths) < candidate.horizon
    if candidate.refined or short or settings.too_few(lengths):
        model = restarted(candidate.model, whitening, white, free)
        model = refine_simulation(model, white, free, REFITS)
    else:
        width = {candidate.horizon: order + settings.n_noise_states}
        spaces = subspaces_of(white, width, settings)
        model = realize(spaces[candidate.horizon], white, order, settings)
    return whitening.undone(model)


# Times that the noise is estimated again, of errors that the last estimate has freed of
# some bias: each brings a clean output's noise nearer by ten.
_ROUNDS = 6


def identify(
    records: Sequence[Record],
    order: int,
    horizon: int,
    settings: Settings,
    known: Candidate | None = None,
    *,
    near: bool = False,
) -> Identified:
    """Model of scaled records; every experiment has its own initial state.

    Refined on the simulation error, then on that error whitened by what noise there is
    in it, or at once by the noise of a model that is `known`; that is all that it
    begins from where it is `near`. With ``compare`` the simpler one is kept where it
    simulates parts held out clearly better.
    """
    none = Whitening.none(len(records[0].y))
    as_found = settings._replace(enforce_stability=False)

    def fit(start: Candidate | None, whitening: Whitening) -> Candidate:
        if near and start is not None:
            return refit(records, start, as_found, whitening)
        begun = None if start is None else start.model
        return fit_once(records, order, horizon, as_found, whitening, begun)

    fitted = chosen = fit(known, none if known is None else known.whitening)
    filtered = known is not None or len(records[0].y) == 1
    some, errors = shorten(records)[0], None
    for _ in range(_ROUNDS if settings.refine and settings.weigh else 0):
        if errors is None:
            errors = simulation_errors(chosen.model, some)
        whitening = Whitening.of(errors, settings.free, filtered=filtered)
        if not whitening.is_close_to(chosen.whitening):
            chosen, errors = fit(chosen, whitening), None
        elif filtered:
            break
        else:  # the weights of the outputs are found
            filtered = True
    if settings.compare and not chosen.whitening.is_none:
        plain = fitted
        if not plain.whitening.is_none:
            found = [  # that which begins at the other goes astray with it
                fit_once(records, order, horizon, as_found, none, start)
                for start in (chosen.model, None)
            ]
            plain = min(found, key=lambda candidate: candidate.model.loss)
        rivals = [chosen, plain, plain._replace(refined=False)]
        if _is_astray(chosen, plain, records, settings):
            rivals = rivals[1:]
        chosen = _best_held_out(rivals, records, as_found)
        if not chosen.refined:
            unrefined = as_found._replace(refine=False)
            chosen = fit_once(records, order, horizon, unrefined, none)
    energy = output_energy(records) or 1.0
    model, stability_loss = chosen.model, 0.0
    if (
        settings.enforce_stability
        and not spectral_radius(model.A) < 1.0 - STABLE_MARGIN
    ):
        model = fit_once(records, order, horizon, settings, chosen.whitening).model
        if 0.0 < chosen.model.loss < model.loss:
            stability_loss = np.sqrt(model.loss / energy)
            stability_loss -= np.sqrt(chosen.model.loss / energy)
    return Identified(
        model,
        chosen.whitening,
        chosen.refined,
        fitted.singular_values,
        float(np.sqrt(model.loss / energy)),
        float(stability_loss),
    )


# Times the squared errors of a model of plain ones, of one of whitened ones that may be
# astray: in records where little but their beginning tells of the inputs, of which the
# filter takes the first samples. And of one that is, for it takes what the inputs do
# for noise: of an order that is too low, which leaves errors that look like it, or of
# a system that is not linear; and of one beside a mode that may follow a drift. One
# with a state to no use has hardly larger ones: units of the criterion by which then.
_ASTRAY, _FAR_ASTRAY, _BEYOND_DRIFTS, _LIKELIER = 2.0, 4.0, 16.0, 10.0
_SETTLES = 5.0  # time constants per record, of modes that follow no drift


def _is_astray(
    chosen: Candidate, plain: Candidate, records: Sequence[Record], settings: Settings
) -> bool:
    """Whether a model of whitened errors is one that errors, or likelihood, refute."""
    longest = max(record.n_samples for record in records)
    settles = n_decays(plain.model.A, longest) > _SETTLES
    least = _FAR_ASTRAY if settles else _BEYOND_DRIFTS
    if chosen.model.loss > least * plain.model.loss:
        return True
    free, repeated = settings.free, settings.repeated
    better = criterion_of(chosen.model, records, free, repeated)
    better -= criterion_of(plain.model, records, free, repeated)
    strays = chosen.model.loss > _ASTRAY * plain.model.loss
    return better > (0.0 if strays else _LIKELIER)


def _best_held_out(
    candidates: Sequence[Candidate], records: Sequence[Record], settings: Settings
) -> Candidate:
    """The first, unless a later one simulates parts held out clearly better.

    Errors that are not whitened, or no refinement, lose to whitened ones unless the
    system is not linear.
    """
    best = candidates[0]
    error = validate(best, records, settings)
    for candidate in candidates[1:]:
        other = validate(candidate, records, settings)
        if other.clearly_better_than(error, DOUBT):
            best, error = candidate, other
    return best


def validate(
    candidate: Candidate, records: Sequence[Record], settings: Settings
) -> HeldOut:
    """Errors of a candidate's like on parts of the records."""
    in_motion = settings._replace(free=settings.free._replace(initial_states=True))
    return held_out(
        lambda train: _refitted(candidate, train, in_motion),
        records,
        weight=candidate.whitening.weight,
    )
