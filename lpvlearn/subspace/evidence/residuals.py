r"""Residual analysis: are the errors of a model white, and do they know the inputs?

Errors e of a model, of simulation or of one-step prediction, are examined for

- **whiteness**: ``Q = n (n + 2) sum_k r_k^2 / (n - k)`` of their autocorrelations r
  (Ljung and Box, 1978);
- **past inputs**: what correlates with ``u[t-1], ..., u[t-M]`` is left of the plant's
  answer: the model lacks states, a delay, a nonlinearity;
- **the present input**: what correlates with ``u[t]``, given the past ones, is a
  feedthrough that the model lacks, or a controller that answers within the sample;
- **future inputs**: what correlates with ``u[t+1], ..., u[t+M]``, given all of these,
  did not come from the input but went to it: feedback.

Errors and inputs are usually both coloured, and correlations of two coloured signals
spread beyond ``1 / sqrt(n)`` without any relation between them (Bartlett). An
autoregression of the errors, ``a(q) e = w`` with white w, takes that away (Haugh,
1976): given the inputs, whatever they are, the regression of w on M of their samples
has exactly the F distribution of ordinary least squares, up to the error of a(q). As
a(q) is causal, it moves no dependence from the past to the future.

On the samples that a model was fitted to, its errors have lost what its parameters
could explain, so that p-values are too large; where the fit did not weight them by
a(q), they also keep what a better fit would have taken. Both lie in the span of the
filtered sensitivities ``a(q) de/dtheta`` of the errors to the parameters. `Fitted`
says what these are; they are regressors before all others (the C(alpha) test of
Neyman), and p-values are right again.

`SubspaceLTI.residual_tests` has the references.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from numbers import Integral
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import linalg, special

from ...data.preparation import DETRENDS, remove_trends
from ...exceptions import warn
from ...models.innovation import InnovationModel
from ...models.statespace import StateSpace, unknown_responses
from ...systems.least_squares import diagonal_scale
from ...systems.simulation import (
    estimate_initial_state,
    spread_of,
    state_and_level,
    trend_signals,
)
from ...systems.threads import one_blas_thread
from ...validation import one_of, share, whole_number
from ..samples.hankel import correlation_sequence, factor_of_pieces
from ..samples.records import centred, thinned
from ..simulation_error.noise import through_filter
from ..simulation_error.simulation_fit import simulation_errors
from .regressions import (
    DEPENDENT,
    ResidualTest,
    f_test,
    filtered,
    of_size_one,
    through_modes,
    whitening_filters,
    without,
)
from .statistics import Evidence

Array = NDArray[np.float64]

N_LAGS = 25  # as in MATLAB's `resid`

# Windows for each lagged input: an autoregression of fewer errors is itself too
# uncertain for the tail of the F distribution.
WINDOWS_PER_LAG = 10

# The same for a number of lags that the user wants, and for each sensitivity: so many,
# that a fair F test remains.
_FEWEST_WINDOWS = 2

# Errors that are rounding, relative to the spread of the output: 24-bit converters and
# single precision resolve 6e-8.
_ROUNDING = 1e-8

# And relative to its largest value: double precision resolves 2e-16, some of which is
# lost in the least squares.
_ROUNDING_OF_LARGEST = 1e-13

_HEAD = 50  # outputs by which an experiment is recognised: measured, hardly the same

_LONGEST_RESPONSE = 500  # of the predictor's filter; what is cut off is negligible

# A lack is told that is all of this:
_MUCH = 0.03  # of the squared errors, at least
MUCH_OF_OUTPUT = 0.003  # of the output, root mean square, at least
BEYOND_CHANCE = 1e-6  # probability by chance, at most

_MAX_SAMPLES = 4_096  # in which a lack is looked for

# Lags by which it is seen at little cost that errors are no larger than need be.
_N_SCREEN = 10

_PIECE = 8192  # windows worked on at a time: they stay in memory


class Fitted(NamedTuple):
    """What was fitted to the samples that are tested.

    The errors are ``W(q)`` times those of simulation: 1, or the predictor's filter.
    """

    poles: NDArray[np.complex128]  # of the deterministic model, with their conjugates
    direct: NDArray[np.bool_]  # (n_outputs, n_inputs), free entries of D
    filter: Array  # (n_terms, n_outputs, n_outputs), impulse response of W
    n_noise: int = 0  # lags of the noise model for each output


def check_kind(errors: str) -> None:
    """Refuse what are no errors of a model, naming those that are."""
    one_of("errors", errors, ("simulation", "prediction"))


class Residuals(NamedTuple):
    """Errors and inputs, an array of one row per sample for each experiment."""

    errors: list[Array]
    inputs: list[Array]
    output_names: Sequence[Hashable]
    input_names: Sequence[Hashable]
    fitted: Fitted | None = None  # None: the model was not fitted to these samples
    n_missing: Sequence[int] | None = None  # of every output; None: none


class CrossCorrelations(NamedTuple):
    """Correlations of every whitened error with every whitened input."""

    lags: NDArray[np.intp]  # -n_lags, ..., n_lags; positive for past inputs
    values: Array  # (n_values, n_outputs, n_inputs): sum_t w[t] v[t - lag] over RMS
    deviation: float  # of independent errors and inputs, at any lag


class InputTests(NamedTuple):
    """Tests ``[output][input]``, each of all samples of that part together.

    The present is tested given the past of all inputs, the future given both.
    """

    past: list[list[ResidualTest]]
    present: list[list[ResidualTest]]
    future: list[list[ResidualTest]]


def model_residuals(
    lti: StateSpace,
    predictor: InnovationModel | None,
    pairs: Sequence[tuple[Array, Array]],
    evidence: Evidence,
    output_names: Sequence[Hashable],
    input_names: Sequence[Hashable],
    detrend: str | None,
) -> Residuals:
    """Errors of one-step prediction (None: of simulation) from estimated states.

    Errors that are rounding become zero, with a warning. The fit is allowed for where
    it was to these samples.
    """
    n_trend = evidence.free.n_trend
    pairs = centred(remove_trends(list(pairs), detrend)[0], n_trend, True)[0]
    outputs = [y for _, y in pairs]
    errors = _errors(lti, predictor, pairs, n_trend)
    # The trend of an answer is not quite the answer to the trend of an input. Inputs
    # are compared with what trends have left of the errors.
    removed = DETRENDS[n_trend] or detrend
    inputs, errors = _without_trends([u for u, _ in pairs], errors, removed)
    errors = _beyond_rounding(errors, outputs, output_names)
    fitted = None
    if _are_of_fit(outputs, evidence):
        fitted = _what_was_fitted(lti, predictor)
    return Residuals(errors, inputs, output_names, input_names, fitted)


def _without_trends(
    inputs: Sequence[Array], errors: Sequence[Array], trend: str | None
) -> tuple[list[Array], list[Array]]:
    """Inputs and errors of experiments, of which no trend explains the other's."""
    cleaned = remove_trends(list(zip(inputs, errors, strict=True)), trend)[0]
    return [u for u, _ in cleaned], [e for _, e in cleaned]


def _errors(
    lti: StateSpace,
    predictor: InnovationModel | None,
    pairs: Sequence[tuple[Array, Array]],
    n_trend: int,
) -> list[Array]:
    """What is left of outputs beside their own initial states and trends."""
    errors = []
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        for u, y in pairs:
            trend = trend_signals(len(y), n_trend)
            if predictor is None:
                free, error = unknown_responses(lti, len(y), trend), y - lti.simulate(u)
                error = error - free @ estimate_initial_state(free, error, spread_of(y))
            else:
                own = predictor.estimate_initial_state(u, y, trend)
                x0, level = state_and_level(own, trend, y.shape[1])
                error = y - level - predictor.predict(u, y - level, initial_state=x0)
            errors.append(error)
    if not all(np.isfinite(e).all() for e in errors):
        raise ValueError(
            "residual tests need a simulation that stays finite. The model is unstable "
            "and diverges over these samples: use stability='enforce', or "
            "errors='prediction' with method='pbsid'."
        )
    return errors


def _beyond_rounding(
    errors: list[Array], outputs: Sequence[Array], names: Sequence[Hashable]
) -> list[Array]:
    """Errors of which those are zero, and told of, that are rounding."""
    y, e = np.vstack(outputs), np.vstack(errors)
    size, largest = np.sqrt(np.mean(e**2, axis=0)), np.abs(y).max(axis=0)
    rounding = size <= _ROUNDING * y.std(axis=0)
    rounding |= size <= _ROUNDING_OF_LARGEST * largest
    if not rounding.any():
        return errors
    share = (size[rounding] / np.where(largest > 0, largest, 1.0)[rounding]).max()
    listed = ", ".join(str(names[k]) for k in np.flatnonzero(rounding).tolist())
    warn(
        f"The errors of {listed} are rounding ({share:.1g} of the output): there is "
        "nothing to test, and all their tests pass."
    )
    return [np.where(rounding, 0.0, part) for part in errors]


def _are_of_fit(outputs: Sequence[Array], evidence: Evidence) -> bool:
    """Whether an experiment begins with the outputs of one of the fit's.

    These are known by the samples that the evidence keeps. Where only a part was fitted
    that costs some power, and no test becomes wrong.
    """
    records, scale = evidence.records, evidence.output_scale
    head = min([_HEAD, *(record.y.shape[1] for record in records)])
    known = {r.y[:, :head].tobytes() for r in records if not r.missing.any()}
    partly = [(r.y.T[:head], r.known[:head]) for r in records if r.missing.any()]

    def is_known(y: Array) -> bool:
        return y.T.tobytes() in known or any(
            there.any() and np.array_equal(y[there], own[there])
            for own, there in partly
        )

    return any(is_known(y[:head] / scale) for y in outputs)


def _what_was_fitted(lti: StateSpace, predictor: InnovationModel | None) -> Fitted:
    response, n_noise = [np.eye(lti.n_outputs)], 0
    if predictor is not None:
        K, C = predictor.K, predictor.C
        n_noise = -(-int(K.any(axis=1).sum()) // lti.n_outputs)
        state, A = K, predictor.A - K @ C
        while len(response) < _LONGEST_RESPONSE and state.any():
            response.append(-C @ state)
            state = A @ state
    return Fitted(lti.poles(), lti.D != 0.0, np.array(response), n_noise)


def input_labels(names: Sequence[Hashable]) -> list[str]:
    """Names of columns; positions become u1, u2, ..."""
    return [
        f"u{j + 1}" if isinstance(name, Integral) else str(name)
        for j, name in enumerate(names)
    ]


def with_windows(residuals: Residuals, n_lags: int | None) -> tuple[Residuals, int]:
    """The experiments long enough for `n_lags` to both sides, and that number.

    None: 25 lags, or what short experiments carry. An experiment must be more than
    four times as long, for the autoregression may take half of its samples. A
    ValueError where too little is left.
    """
    errors, inputs, fitted = residuals.errors, residuals.inputs, residuals.fitted
    m, lengths = inputs[0].shape[1], [len(e) for e in errors]
    n_own = 0
    if fitted is not None:
        n_filters = np.count_nonzero(np.abs(fitted.filter).sum(axis=0), axis=1).max()
        n_own = (2 * len(fitted.poles) + 1) * m * int(n_filters)
    tried, each = range(N_LAGS, 0, -1), WINDOWS_PER_LAG
    if n_lags is not None:
        wanted = whole_number("n_lags", n_lags, 1)
        tried, each = range(wanted, wanted - 1, -1), _FEWEST_WINDOWS
    for k in tried:
        kept = [i for i, n in enumerate(lengths) if n > 4 * k]
        windows = sum(lengths[i] - 2 * k for i in kept)
        needed = each * 2 * k * m + _FEWEST_WINDOWS * n_own
        if windows >= needed:
            errors, inputs = ([x[i] for i in kept] for x in (errors, inputs))
            return residuals._replace(errors=errors, inputs=inputs), k
    raise ValueError(
        f"residual tests of {k} lag(s) need an experiment of at least "
        f"{max(needed + 2 * k, 4 * k + 1)} samples for {m} input(s)"
        f"{' of a model fitted to it' if n_own else ''}. Got {max(lengths)}"
        f"{'.' if n_lags is None else '; lower `n_lags`.'}"
    )


def residual_tests(
    residuals: Residuals, *, n_lags: int | None = None, level: float = 0.01
) -> pd.DataFrame:
    """All tests as a table.

    Examples
    --------
    >>> import numpy as np
    >>> e, u = np.random.default_rng(1).standard_normal((2, 1000, 1))
    >>> e[3:] += 0.2 * u[:-3]
    >>> table = residual_tests(Residuals([e], [u], ["y1"], ["u1"]))
    >>> table[["output", "test", "input", "dof", "passed"]]
      output           test input  dof  passed
    0     y1      whiteness         25    True
    1     y1    past inputs    u1   25   False
    2     y1  present input    u1    1    True
    3     y1  future inputs    u1   25    True
    """
    level = share("level", level)
    residuals, n_lags = with_windows(residuals, n_lags)
    errors, inputs, output_names, input_names, fitted, n_missing = residuals
    white = whiteness_tests(errors, n_lags, 0 if fitted is None else fitted.n_noise)
    by_input = input_tests(errors, inputs, n_lags, fitted)
    names = "past inputs", "present input", "future inputs"
    rows: list[tuple[object, ...]] = []
    for i, output in enumerate(output_names):
        rows.append((output, "whiteness", "", *white[i]))
        for test, found in zip(names, by_input, strict=True):
            for name, one in zip(input_names, found[i], strict=True):
                rows.append((output, test, name, *one))
    table = pd.DataFrame(
        rows, columns=["output", "test", "input", "statistic", "dof", "p_value"]
    )
    table["passed"] = table["p_value"] >= level
    lost = [0] * len(output_names) if n_missing is None else n_missing
    table["n_missing"] = np.repeat(lost, len(table) // len(lost))
    return table


def autocorrelations(errors: Sequence[Array], n_lags: int) -> Array:
    """Autocorrelations of every output, shape (n_lags + 1, n_outputs).

    Pooled over experiments; products never cross the border between two. The first row
    is 1, 0 for errors that are all zero.

    Examples
    --------
    >>> import numpy as np
    >>> autocorrelations([np.array([[1.0], [-1.0], [1.0]])], 1).ravel().round(3)
    array([ 1.   , -0.667])
    """
    sums = np.zeros((n_lags + 1, errors[0].shape[1]))
    for e in errors:
        known = min(len(e), n_lags + 1)
        for i, one in enumerate(e.T):
            sums[:known, i] += correlation_sequence(one[:, None], known)[:, 0, 0]
    return sums / np.where(sums[0] > 0.0, sums[0], 1.0)


def cross_correlations(
    errors: Sequence[Array], inputs: Sequence[Array], n_lags: int
) -> CrossCorrelations:
    """Correlations with past and future inputs, both whitened first (Haugh).

    Those of the signals as they are would spread over all lags, in a band so wide that
    little were to be seen. Causal filters leave past and future apart.
    """
    ny = errors[0].shape[1]
    filters = whitening_filters(errors) + whitening_filters(inputs)
    n_samples, sums = 0, np.zeros((n_lags + 1, len(filters), len(filters)))
    signals = [np.hstack(pair) for pair in zip(errors, inputs, strict=True)]
    for z in filtered(signals, filters):
        known = min(len(z), n_lags + 1)
        if known:
            n_samples += len(z)
            sums[:known] += correlation_sequence(z, known)  # of t with t + lag
    size = diagonal_scale(sums[0])
    r = sums / size[:, None] / size
    values = np.concatenate([r[:0:-1, :ny, ny:], r[:, ny:, :ny].swapaxes(1, 2)])
    lags = np.arange(-n_lags, n_lags + 1)
    return CrossCorrelations(lags, values, n_samples**-0.5)


def whiteness_tests(
    errors: Sequence[Array], n_lags: int, n_fitted: int = 0
) -> list[ResidualTest]:
    """Ljung-Box test of every output.

    A noise model fitted to these samples takes `n_fitted` degrees of freedom of each;
    as many lags are added, so that `n_lags` of them remain.
    """
    r = autocorrelations(errors, n_lags + n_fitted)[1:]
    n = sum(map(len, errors))
    # Products that the sum at each lag holds; n - k for one experiment.
    counts = np.array(
        [sum(max(0, len(e) - k - 1) for e in errors) for k in range(len(r))]
    )
    seen = counts > 0
    dof = max(1, int(seen.sum()) - n_fitted)
    statistics = n * (n + 2) * np.sum(r[seen] ** 2 / counts[seen, None], axis=0)
    return [
        ResidualTest(float(q), dof, float(special.chdtrc(dof, q))) for q in statistics
    ]


@one_blas_thread
def input_tests(
    errors: Sequence[Array],
    inputs: Sequence[Array],
    n_lags: int,
    fitted: Fitted | None = None,
) -> InputTests:
    """Do errors depend on past, present and future inputs?"""
    m, n_rows = inputs[0].shape[1], 2 * n_lags + 1
    tests = InputTests([], [], [])
    for i, a in enumerate(whitening_filters(errors)):
        start, parts = len(a) - 1, []
        for e, u in zip(errors, inputs, strict=True):
            if len(e) < start + n_rows:
                continue
            own = [] if fitted is None else _sensitivities(fitted, i, u)
            white = through_filter(a, np.column_stack([*own, e[:, i]]))
            parts.append((white[n_lags : len(white) - n_lags].T, u[start:]))
        n = sum(white.shape[1] for white, _ in parts)
        columns = of_size_one(_factor(parts, n_rows))
        n_own = columns.shape[1] - 1 - n_rows * m
        starts = n_own + m * np.array([0, n_lags, n_lags + 1, n_rows])
        for found, first, stop in zip(tests, starts[:-1], starts[1:], strict=True):
            left, n_known = without(columns[:, :first], columns)
            added = [left[:, first + j : stop : m] for j in range(m)]
            found.append([f_test(part, left[:, -1], n - n_known) for part in added])
    return tests


def lacks(evidence: Evidence, innovations: Array) -> bool:
    """Whether errors of a fit clearly depend on past inputs, and not just by a little.

    `innovations` are variances of the errors of a long regression on the past, in the
    scale of the records: a model whose errors are as small is not looked at.
    """
    if not np.isfinite(evidence.model.loss):
        return False
    records = thinned(evidence.records, _MAX_SAMPLES)
    model, trend = evidence.begun_in(records), DETRENDS[evidence.free.n_trend]
    errors = simulation_errors(model, records)
    inputs, errors = _without_trends([record.u.T for record in records], errors, trend)
    outputs = np.hstack([record.y for record in records])
    size = np.mean(outputs**2, axis=1)
    variances = np.mean(np.vstack(errors) ** 2, axis=0)

    def much(variance: Array) -> NDArray[np.bool_]:
        lacking = variance - innovations
        return (lacking > _MUCH * variance) & (lacking > MUCH_OF_OUTPUT**2 * size)

    if not much(variances).any():
        return False
    suspects = np.flatnonzero(much(_predicted_variances(errors)))
    if not len(suspects):
        return False
    poles = np.linalg.eigvals(model.A).astype(complex)
    fitted = Fitted(poles, evidence.free.direct, np.eye(len(size))[None])
    share = explained_by_inputs(errors, inputs, fitted)
    return bool((share[suspects] > _MUCH).any())


def explained_by_inputs(
    errors: Sequence[Array], inputs: Sequence[Array], fitted: Fitted | None = None
) -> Array:
    """Share of the squared errors of every output that past inputs explain.

    Of the whitened errors, by the input that explains most; 0 where that may be chance,
    or the samples are too few to tell.
    """
    names = list(range(errors[0].shape[1])), list(range(inputs[0].shape[1]))
    try:
        found, n_lags = with_windows(
            Residuals(list(errors), list(inputs), *names, fitted), None
        )
    except ValueError:
        return np.zeros(errors[0].shape[1])
    n = sum(map(len, found.errors))
    tests = input_tests(found.errors, found.inputs, n_lags, fitted).past
    return np.array(
        [
            max(
                (test.statistic - test.dof) / (test.statistic + n)
                if test.p_value < BEYOND_CHANCE
                else 0.0
                for test in of_output
            )
            for of_output in tests
        ]
    )


def _predicted_variances(errors: Sequence[Array]) -> Array:
    """Variances of the errors of every output, given some of its last ones."""
    r = autocorrelations(errors, _N_SCREEN)
    r[0] *= 1.0 + DEPENDENT**2
    explained = [
        one[1:] @ linalg.solve_toeplitz(one[:-1], one[1:]) if one[0] else 0.0
        for one in r.T
    ]
    return np.mean(np.vstack(errors) ** 2, axis=0) * (1.0 - np.array(explained))


def _sensitivities(fitted: Fitted, output: int, u: Array) -> list[Array]:
    r"""Signals that span the change of one output's errors by A, B, C and free D.

    The simulated outputs change by combinations of ``u_j / (z - p_k)`` and
    ``u_j / ((z - p_k) (z - p_l))``: of all inputs through every pole taken twice. Each
    follows an all-pass of the poles before it (Takenaka and Malmquist), so that they
    are orthogonal for a white input and close poles do no harm. Thrice would allow for
    curvature, but then a mode that is missing beside another one goes unseen.
    """
    states = through_modes(fitted.poles, u, 2)
    driven = [np.hstack([states, u[:, free]]) for free in fitted.direct]
    return [
        scipy.signal.lfilter(h, [1.0], signals, axis=0)
        for h, signals in zip(fitted.filter[:, output].T, driven, strict=True)
        if h.any() and signals.size
    ]


def _factor(parts: Sequence[tuple[Array, Array]], n_rows: int) -> Array:
    """Upper triangular factor of the windows of all experiments.

    Columns: filtered sensitivities, `n_rows` samples of all inputs, filtered error.
    """

    def pieces() -> Iterator[Array]:
        for white, u in parts:
            view = np.lib.stride_tricks.sliding_window_view(u, n_rows, axis=0)
            for start in range(0, len(view), _PIECE):
                piece = slice(start, start + _PIECE)
                lagged = view[piece].transpose(2, 1, 0).reshape(n_rows * u.shape[1], -1)
                yield np.vstack([white[:-1, piece], lagged, white[-1:, piece]])

    gram = np.asarray(sum(piece @ piece.T for piece in pieces()))
    return factor_of_pieces(gram, pieces()).T
