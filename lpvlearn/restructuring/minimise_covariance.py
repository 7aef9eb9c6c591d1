r"""Minimisation of the distance to a black box in units of its own uncertainty.

An identified black box of order n is uncertain in p = n (n_inputs + n_outputs)
directions, and one more for every free entry of D. Its response g0 (all frequencies and
entries, real parts, then imaginary parts: N numbers) moves along them by the columns of
V, shape (N, p), when its parameters move by one standard deviation each. To first order
g0 then has the covariance ``Sigma = V V^T``, of rank p, and the efficient parameters
are those of generalised least squares (Gauss and Markov; Aitken),

    min over theta of  (g(theta) - g0)^T Sigma^+ (g(theta) - g0) = |z(theta)|^2,
    z(theta) = V^+ (g(theta) - g0),                                    shape (p,).

z are local coordinates of the black box, with the covariance I: how many standard
deviations away, in p independent directions, the structured model lies. They depend on
transfer functions alone, so no similarity transformation is involved. The rows of V are
divided by the standard deviations of the entries before it is inverted: any left
inverse of V gives the same estimate to first order, and this one depends neither on
the units of a channel nor on those of time.

With J the derivative of z, the covariance of theta is ``(J^T J)^-1``. If the black box
is efficient (white noise, simulation error minimised) this is the Cramer-Rao bound of
the structure: the estimate has the asymptotic distribution of gray-box maximum
likelihood (the indirect prediction error method of Soderstrom, Stoica and Friedlander,
Automatica 27, 1991). If the structure is true, the minimum is a chi-square with p minus
n_params degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.sparse import diags_array
from scipy.stats import chi2

from ..models.statespace import DEVIATION, ModelPair, StateSpace
from ..structures.structure import GrayBoxStructure
from ..systems.least_squares import levenberg_marquardt, thin_svd
from .deadline import time_is_up
from .error_system import ErrorSystem, Structure, Target, remembering
from .known_poles import divide
from .limits import Limits, keeps_margin, natural_margin
from .singular_points import bend_of, squared_combinations

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

Estimate = tuple[StateSpace, Sequence[ModelPair]]  # with models on either side of it

# Standard deviations below this part of a channel's largest gain cannot be told from
# rounding: the models of a pair differ by a fiftieth of it, their responses are exact
# to some 1e-13.
_EXACT = 1e-9

_MAX_ITER = 100  # steps of a search; one that has not ended by then is told

# Relative singular value of the scaled V below which a direction is rounding. Well
# excited models stay above 1e-3; in the differences of pairs 1e-6 is still exact.
_FAINT = 1e-6

_UNDETERMINED = 1e-9  # the same of the scaled J, as in the analysis of identifiability

# A step that lowers |z|^2 by less moves no parameter by more than a thousandth of its
# standard deviation (or of the greater one that the misfit of a wrong structure makes).
_SETTLED = 1e-6

# Relative decrease of |z|^2, twice in a row, that ends the iteration: it converges
# quadratically near a true structure, where |z|^2 is about p, so that a last step to
# rounding costs nothing.
_DECREASE = 1e-10

# A structure is doubted where chance explains it that rarely, and the parameters would
# suffer: errors of twice the standard deviations that are told.
IMPLAUSIBLE, _MISFIT = 1e-3, 4.0

# Steps over many systems, and the relative decrease of their chi-square that ends them
_MANY, _ROUGH = 60, 1e-8


@dataclass(frozen=True)
class UncertainResponse:
    """The response of a black box, and the coordinates of its uncertainty."""

    omega: Array  # (k,), rad/s
    response: Complex  # g0: (k, n_outputs, n_inputs)
    whitening: Any  # V^+: (p, 2 k n_outputs n_inputs), an array or a sparse one

    def coordinates(self, response: Complex) -> Array:
        """``z = V^+ (g - g0)``, shape (p,), of another response."""
        return np.asarray(self.whitening @ _parts(response - self.response))

    def derivatives(self, jacobian: Complex) -> Array:
        """Those of the coordinates, (p, q), from the response's, (k, ..., q)."""
        return np.asarray(self.whitening @ _parts(jacobian, jacobian.shape[-1]))


def _parts(response: Complex, *columns: int) -> Array:
    flat = response.reshape(-1, *columns)
    return np.concatenate([flat.real, flat.imag])


def uncertain_response(
    model: StateSpace, pairs: Sequence[ModelPair], omega: Array
) -> UncertainResponse | None:
    """Response of a black box with its covariance, from models on either side of it.

    `pairs` stand along independent directions as `deviated_models` has them, in any
    state basis; `omega` must tell models of that order apart. Delays are left out. None
    where no uncertainty is known, or none is left beyond rounding.
    """
    if len(pairs) == 0:
        return None

    def response(of: StateSpace) -> Complex:
        return of.with_input_delay(0).frequency_response(omega)

    G = response(model)
    changes = [response(above) - response(below) for above, below in pairs]
    V = np.column_stack([_parts(change) for change in changes]) / (2 * DEVIATION)
    std = np.linalg.norm(V, axis=1)
    largest = np.broadcast_to(np.abs(G).max(0), G.shape)
    floor = _EXACT * np.concatenate([largest.ravel()] * 2)
    if not np.isfinite(std).all() or not (std > floor).any():
        return None
    std = np.maximum(std, floor)
    std = np.where(std > 0, std, 1.0)  # a channel without any gain
    U, s, _ = thin_svd(V / std[:, None])
    kept = s > _FAINT * s[0]
    return UncertainResponse(omega, G, (U[:, kept] / s[kept]).T / std)


def measured_response(omega: Array, G: Complex, std: Array) -> UncertainResponse:
    """A measured response whose entries have independent errors.

    `std` (k, n_outputs, n_inputs) are standard deviations of the whole complex errors,
    of whose variance the real part has half.
    """
    return UncertainResponse(
        omega, G, diags_array(np.sqrt(2.0) / _parts(std + 1j * std))
    )


@dataclass(frozen=True)
class UncertainBoxes:
    """Independent black boxes of one system, in whose uncertainty a structure stands.

    `system` is that of the structure: its black box and weight do not enter.
    """

    system: ErrorSystem
    boxes: Sequence[UncertainResponse]

    @classmethod
    def of(
        cls,
        structure: GrayBoxStructure,
        estimates: Sequence[Estimate],
        sampling_time: float | None = None,
    ) -> UncertainBoxes | None:
        """Of estimates with their models on either side; None where one has none.

        Where these are in discrete time and the structure (`sampling_time`) is not, it
        is sampled behind a hold.
        """
        first = estimates[0][0]
        target = Target(first.A, first.B, first.C, first.D, first.sampling_time)
        division = divide(structure, sampling_time, [target])[1]
        own: Structure = structure
        if first.sampling_time is not None and sampling_time is None:
            own = SampledStructure(structure, first.sampling_time)
        system = ErrorSystem(own, target)
        grid = system.grid if division is None else division.grid(target)
        if first.sampling_time is not None:
            grid = grid[grid < np.pi / first.sampling_time]
        found = [uncertain_response(box, pairs, grid) for box, pairs in estimates]
        boxes = [box for box in found if box is not None]
        return cls(system, boxes) if len(boxes) == len(found) else None

    @property
    def n_directions(self) -> int:
        """Length of `coordinates`."""
        return sum(box.whitening.shape[0] for box in self.boxes)

    def coordinates(self, theta: Array) -> tuple[Array, Array]:
        """``z`` of all black boxes, one after another, and its derivatives."""
        z, J = [], []
        for box in self.boxes:
            G, dG = self.system.response_jacobian(theta, box.omega)
            z.append(box.coordinates(G))
            J.append(box.derivatives(dG))
        return np.concatenate(z), np.vstack(J)


@dataclass(frozen=True)
class CovarianceFit:
    """Efficient parameters and what is known about them.

    The covariance is zero for parameters held at a bound, and infinite on the diagonal
    for those that the black box does not determine.
    """

    theta: Array  # (n_params,)
    cost: float  # |z|^2
    degrees_of_freedom: int  # known directions minus parameters that they determine
    covariance: Array  # (n_params, n_params)
    converged: bool  # a further step would change the parameters by next to nothing

    @property
    def p_value(self) -> float:
        """Of such a cost, or a higher one, if the structure is true."""
        return _chance(self.cost, self.degrees_of_freedom)

    @property
    def misfit(self) -> float:
        """Cost by degree of freedom: about 1 where the structure is true."""
        return self.cost / max(self.degrees_of_freedom, 1)

    @property
    def is_plausible(self) -> bool:
        """Whether the noise explains the cost, or nearly."""
        return is_explained(self.cost, self.degrees_of_freedom)


def _chance(cost: float, degrees_of_freedom: float) -> float:
    return float(chi2.sf(cost, degrees_of_freedom)) if degrees_of_freedom else 1.0


def is_explained(cost: float, degrees_of_freedom: float) -> bool:
    """Whether noise explains a squared distance, or nearly."""
    near = cost <= _MISFIT * max(degrees_of_freedom, 1)
    return near or _chance(cost, degrees_of_freedom) >= IMPLAUSIBLE


def efficient_parameters(
    structure: GrayBoxStructure,
    estimates: Sequence[Estimate],
    start: Array,
    *,
    others: Sequence[Array] = (),
    sampling_time: float | None = None,
    admissible: Callable[[Array], bool] | None = None,
    astray: Callable[[Array], bool] | None = None,
) -> CovarianceFit | None:
    """Parameters of a structure from independent estimates of one system.

    The estimates are those of all experiments, or of each realization of the noise, as
    for `UncertainBoxes`. None where an uncertainty is not known, or the start does not
    keep the stability margin. If the noise does not explain what is found, the search
    begins at `others` as well: in other units of the outputs another basin is the
    lowest. Where all that is found is `astray`, so far from the black box that the
    uncertainty can be none of its, the start stays. Of models with known poles a margin
    says nothing: what is `admissible` is given.
    """
    known = UncertainBoxes.of(structure, estimates, sampling_time)
    if known is None:
        return None
    system, boxes = known.system, known.boxes
    margin = natural_margin(system.target)

    def search(start: Array, max_iter: int = _MAX_ITER) -> CovarianceFit | None:
        return minimise_covariance(
            system, start, margin, boxes, admissible=admissible, max_iter=max_iter
        )

    best = search(start)
    if best is None or best.is_plausible:
        return best
    found = [best, *map(search, others)]
    best = min((fit for fit in found if fit is not None), key=lambda fit: fit.cost)
    if astray is None or best.is_plausible or not astray(best.theta):
        return best
    stays = search(start, 0)
    return None if stays is None else replace(stays, converged=True)  # it is no search


def minimise_covariance(
    system: ErrorSystem,
    start: Array,
    margin: float,
    boxes: Sequence[UncertainResponse],
    *,
    admissible: Callable[[Array], bool] | None = None,
    max_iter: int = _MAX_ITER,
) -> CovarianceFit | None:
    """Parameters nearest to black boxes in the metric of their own uncertainty.

    `system` is that of the structure (its black box and weight do not enter), `start`
    in the basin of the optimum, e.g. where the H-infinity norm is least; the costs of
    independent black boxes add up. A structure that can be any model of the black box's
    order returns the black box, with ``cost = 0`` and
    ``(dg/dtheta) covariance (dg/dtheta)^T = Sigma``.

    Examples
    --------
    The gain of a lag that the black box knows to 0.1, its pole to 0.2:

    >>> import numpy as np
    >>> from lpvlearn import GrayBoxStructure, StateSpace
    >>> from lpvlearn.restructuring.problem import problem_from_models
    >>> lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    >>> box = StateSpace(-2.0, 3.0, 1.0)
    >>> pairs = [(StateSpace(-2.002, 3.0, 1.0), StateSpace(-1.998, 3.0, 1.0)),
    ...          (StateSpace(-2.0, 3.001, 1.0), StateSpace(-2.0, 2.999, 1.0))]
    >>> problem = problem_from_models(lag, [box], None)
    >>> estimate = uncertain_response(box, pairs, problem.omega)
    >>> found = minimise_covariance(
    ...     problem.system, np.array([1.0, 1.0]), problem.margin, [estimate])
    >>> found.theta.round(6)
    array([2., 3.])
    >>> np.sqrt(np.diag(found.covariance)).round(4)
    array([0.2, 0.1])
    """

    coordinates = UncertainBoxes(system, boxes).coordinates

    def residuals(x: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        if not kept(x[0]):
            return np.full((1, 1), np.nan), lambda _: np.zeros((1, 1, x.shape[1]))
        z, J = coordinates(x[0])
        return z[None], lambda _: J[None]

    kept = admissible or (lambda theta: keeps_margin(system, theta, margin))
    if admissible is None and not kept(start):  # in the leeway that its search had
        kept = Limits(system, margin).admissible
    lower, upper = system.structure.lower, system.structure.upper
    reached, costs = levenberg_marquardt(
        residuals,
        np.asarray(start, dtype=float)[None],
        lower=lower,
        upper=upper,
        max_iter=max_iter,
        tol=_DECREASE,
        stop=time_is_up,
    )
    theta, cost = reached[0], float(costs[0])
    if not np.isfinite(cost):
        return None
    z, J = coordinates(theta)
    gradient = J.T @ z
    held = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
    J = np.where(held, 0.0, J)
    covariance, explained, combinations = _linear_analysis(J)
    if len(combinations):
        bend = bend_of(lambda x: coordinates(x)[0], theta, lower, upper)
        sizes = np.where(theta == 0.0, 1.0, np.abs(theta))
        size = float(np.linalg.norm(J * sizes))
        more = squared_combinations(J, combinations, sizes, bend, size)
        covariance = _linear_analysis(np.column_stack([J, more]))[0]
        covariance = covariance[: len(theta), : len(theta)]
    freedom = len(z) - explained.shape[1]
    remaining = float(np.sum((explained.T @ z) ** 2))  # gain of a Gauss-Newton step
    return CovarianceFit(
        theta,
        cost,
        freedom,
        covariance,
        converged=remaining <= _SETTLED * max(1.0, cost / max(freedom, 1)),
    )


def common_coefficients(
    systems: Sequence[UncertainBoxes], maps: Array, start: Array
) -> tuple[Array, float, Array]:
    """Coefficients whose parameters ``theta_k = maps_k c`` are nearest to all systems.

    They minimise ``sum_k |z_k(maps_k c)|^2``, from a `start`; `maps` have the shape
    (n_systems, n_params, n_coefficients). Returns c, the cost, and the derivatives of
    all z there.
    """

    def coordinates(c: Array) -> tuple[Array, Array]:
        pairs = [of.coordinates(M @ c) for of, M in zip(systems, maps, strict=True)]
        slopes = [J @ M for (_, J), M in zip(pairs, maps, strict=True)]
        return np.concatenate([z for z, _ in pairs]), np.vstack(slopes)

    def residuals(x: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        with np.errstate(all="ignore"):  # a step too far is refused
            z, J = coordinates(x[0])
        return z[None], lambda _: J[None]

    reached, costs = levenberg_marquardt(
        residuals, start[None], max_iter=_MANY, tol=_ROUGH, stop=time_is_up
    )
    with np.errstate(all="ignore"):  # of a start too far, which stays
        slopes = coordinates(reached[0])[1]
    return reached[0], float(costs[0]), slopes


def _linear_analysis(J: Array) -> tuple[Array, Array, Array]:
    """``(J^T J)^-1``, orthonormal columns that span the range of J, rows the kernel.

    A column of zeros has no variance; parameters of a combination that J does not
    determine have an infinite one.
    """
    unit = np.linalg.norm(J, axis=0)
    free = unit > 0
    unit = np.where(free, unit, 1.0)
    U, s, Vt = np.linalg.svd(J[:, free] / unit[free])
    s = np.concatenate([s, np.zeros(len(Vt) - len(s))])
    known = s > _UNDETERMINED * s.max(initial=0.0)
    part = (Vt[known].T / s[known] ** 2) @ Vt[known]
    open_ = np.abs(Vt[~known]).max(0, initial=0.0) > _UNDETERMINED
    part[np.diag_indices(len(part))] += np.where(open_, np.inf, 0.0)
    covariance = np.zeros((len(unit), len(unit)))
    covariance[np.ix_(free, free)] = part
    kernel = np.zeros((int((~known).sum()), len(unit)))
    kernel[:, free] = Vt[~known]
    return covariance / unit[:, None] / unit, U[:, : int(known.sum())], kernel / unit


class SampledStructure:
    r"""The discrete-time models of a continuous-time structure, exact for held inputs.

        exp(M dt) = [[Ad, Bd], [0, I]],   M = [[A, B], [0, 0]],

    C and D as they are. The derivatives by theta_j are the blocks of

        exp([[M, M_j], [0, M]] dt) = [[exp(M dt), d exp(M dt) / d theta_j],
                                      [0, exp(M dt)]]

    (Van Loan, 1978). A black box in discrete time is so matched where it was
    identified: one with a pole on the negative real axis has no logarithm.

    It takes the place of a structure in an `ErrorSystem` whose black box has the same
    sampling time. Structures that differ by modes beyond the Nyquist frequency have
    the same samples: begin near the parameters that are meant.
    """

    is_affine = False

    def __init__(self, structure: Structure, sampling_time: float) -> None:
        self.structure, self.sampling_time = structure, sampling_time
        self.order, self.n_params = structure.order, structure.n_params
        self.lower, self.upper = structure.lower, structure.upper
        self._sampled = remembering(self._sample)

    def system_matrix(self, theta: Array) -> Array:
        """``[[Ad, Bd], [C, D]]``; not finite where the sampled model overflows."""
        return np.asarray(self._sampled(theta)[0])

    def jacobian(self, theta: Array) -> Array:
        """Its derivatives, shape (n_params, order + n_outputs, order + n_inputs)."""
        return np.asarray(self._sampled(theta)[1])

    def curvature(self, theta: Array) -> Array | None:
        """Not known: the structure serves least squares, not the minimax."""
        return None

    def _sample(self, theta: Array) -> tuple[Array, Array]:
        n, dt = self.order, self.sampling_time
        S, dS = self.structure.system_matrix(theta), self.structure.jacobian(theta)
        size = S.shape[1]
        # the units of a parameter must not enter the norm that expm scales by
        unit = np.abs(dS[:, :n]).max((1, 2), initial=0.0, keepdims=True)
        unit = np.where(unit > 0, unit, 1.0) / np.abs(S[:n]).max(initial=1e-300)
        M = np.zeros((self.n_params, 2 * size, 2 * size))
        M[:, :n, :size] = M[:, size : size + n, size:] = S[:n] * dt
        M[:, :n, size:] = dS[:, :n] / unit * dt
        with np.errstate(over="ignore", invalid="ignore"):
            E = expm(M) if np.isfinite(M).all() else np.full_like(M, np.nan)
        return (
            np.vstack([E[0, :n, :size], S[n:]]),
            np.concatenate([E[:, :n, size:] * unit, dS[:, n:]], axis=1),
        )
