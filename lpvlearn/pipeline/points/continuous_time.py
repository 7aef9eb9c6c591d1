"""Local models in continuous time: poles that grow, integrate or alternate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...exceptions import collected, take_back, warn
from ...models.statespace import ModelPair, StateSpace, forgetting
from .fitting import alternating

# A pole that much slower than the others is an integrator, and an output shows it by
# more than that part of the output that does most.
_STANDING = 0.05

_ABOUT_ZERO = 0.25  # of the others: it may be one, known by samples that are not many
NOTHING = 1e-6  # share by which what does not decay, to rounding, may do so or grow
HARDLY = 0.05  # share by which an integrator may decay, or grow, in a record
_GROWN = 3.0  # time constants per record, up to which one that grows may be one

ALTERNATES = "alternates"  # the kind of a warning, of poles on the negative real axis


class Advice(NamedTuple):
    """What to do about a model that grows."""

    first: str = "Try "
    of_rates: bool = False  # whose outputs are named
    in_loop: bool = False

    def text(self, named: str) -> str:
        """With what is advised for outputs that integrate, `named`."""
        held, enforced = "", "stability='enforce', "
        if self.in_loop:  # as no plant is that only its controller holds
            enforced = ""
            held = (
                "If only its controller holds the plant, identify the closed loop, "
                "with the controller's reference as input and the controller in the "
                "structure. "
            )
        return (
            f"{named}{held}{self.first}local=SubspaceLTI(offset='linear') if the "
            f"outputs drift, {enforced}another `order`, a longer `horizon` or more "
            "data, or leave the point out by on_error='skip'."
        )


TWICE = Advice(
    "Where rates integrate as well, as the velocity of what nothing holds, have a "
    "structure say so: restructurer=GrayBoxRestructurer(structure) with zeros in its "
    "A. Else try ",
    of_rates=True,
)


class Integrates(ValueError):
    """A local model is refused, for poles about zero: outputs may integrate."""


class AboutZero(NamedTuple):
    """Poles that are known to be at zero: their number, and how near estimates are."""

    n_poles: int = 0
    rate: float = 0.0  # 1/s

    def others(self, poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Poles of a model without estimates of these."""
        poles = poles[np.argsort(np.abs(poles))]
        far = np.abs(poles) > self.rate
        far[self.n_poles :] = True
        return poles[far]

    def are_all_that_last(self, poles: NDArray[np.complex128]) -> bool:
        """Whether a model has estimates of these, and all others decay."""
        others = self.others(poles)
        return len(others) < len(poles) and bool((others.real < -self.rate).all())


def continuous(
    model: StateSpace, discretization: str, advice: Advice, about_zero: AboutZero
) -> StateSpace:
    with collected():  # said below
        lti = model.to_continuous(discretization)
    growth = about_zero.others(lti.poles()).real.max(initial=-np.inf)
    if 0.0 <= growth <= NOTHING * about_zero.rate:
        lti = forgetting(lti, 2.0 * NOTHING * about_zero.rate)
    elif growth > 0.0:
        worst = lti.poles()[np.argmax(lti.poles().real)]
        named = ""
        if not advice.of_rates:
            named = integrating_outputs(lti, _GROWN * about_zero.rate)
        raise (Integrates if named else ValueError)(
            f"the local model must be stable. Got a pole at {worst:.4g} 1/s. "
            f"{advice.text(named)}"
        )
    take_back("border")
    if lti.order > model.order:
        poles = alternating(model)
        warn(
            f"the identified model of order {model.order} has "
            f"{lti.order - model.order} pole(s) on the negative real axis "
            f"({', '.join(f'{p:.3g}' for p in poles)}), as no continuous-time model of "
            "that order has: without a structure what becomes of the point is near it "
            "at low frequencies only. A shorter sampling time or a lower `order` "
            "avoids it.",
            kind=ALTERNATES,
        )
    return lti


def with_slower_rates(lti: StateSpace, n_integrators: int, rate: float) -> StateSpace:
    """A model whose poles are that much (1/s) lower, but for so many at zero.

    With ``A v = 0`` for as many directions as before.
    """
    kept = np.linalg.svd(lti.A)[2][: lti.order - n_integrators]
    return lti._of(lti.A - rate * kept.T @ kept, lti.B, lti.C, lti.D)


def integrating_places(lti: StateSpace, rate: float) -> list[int]:
    """Which outputs integrate, where slow poles are about zero: within a `rate`, 1/s.

    And nearer to it than all others. They are those of the outputs that show them, two
    of one that integrates twice.
    """
    poles, V = np.linalg.eig(lti.A)
    slow = np.abs(poles) <= rate
    others = np.abs(poles[~slow]).min(initial=np.inf)
    if not slow.any() or np.abs(poles[slow]).max() > _ABOUT_ZERO * others:
        return []
    size = np.linalg.norm(lti.C, axis=1)  # of outputs in any unit
    seen = np.linalg.norm(lti.C @ V[:, slow], axis=1) / np.where(size > 0.0, size, 1.0)
    return np.flatnonzero(seen > _STANDING * seen.max()).tolist()


def integrating_outputs(lti: StateSpace, rate: float) -> str:
    """What to do about outputs that integrate, if there are any, up to a `rate`."""
    places = integrating_places(lti, rate)
    if not places:
        return ""
    return (
        f"If the outputs at {places} (positions in y) integrate, name them: "
        f"local=SubspaceLTI(integrating={places}) identifies their rates. "
    )


def in_own_time(
    model: StateSpace, pairs: list[ModelPair], method: str
) -> tuple[StateSpace, list[ModelPair]]:
    """In discrete time where inputs are held, else as the continuous-time model."""
    if method == "zoh":
        return model, pairs
    return model.to_continuous(method), all_continuous(pairs, method)


def all_continuous(pairs: list[ModelPair], method: str) -> list[ModelPair]:
    with collected():  # the estimate's own conversion says it once
        return [(a.to_continuous(method), b.to_continuous(method)) for a, b in pairs]
