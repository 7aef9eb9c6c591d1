"""Inputs that nothing but the rounding of their numbers tells apart."""

from __future__ import annotations

import numpy as np

from ...data.preparation import Rounded
from ...exceptions import RankWarning
from ..evidence.constants import CERTAIN
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples
from .trends import with_trends

# Times the gain of all else that inputs do, beyond which a model makes of their ripple
# what it likes
_WILD = 10.0

_LOOKED_AT = np.geomspace(1e-2, 3.0, 8)  # rad per sample: where the gains are compared

_PART = 0.05  # of the largest ripple, from which an input is one of those named


def without_rounding(
    samples: Samples, whole: LocalFit, like: LocalFit | None
) -> tuple[Samples, LocalFit]:
    """Take out a ripple of inputs that only the rounding of their numbers makes.

    A model makes of it what it likes, unless the ripple is what drives outputs.
    """
    pairs, telling = samples.pairs, samples.telling
    rounded = Rounded.of([u for u, _ in pairs])
    if rounded is None or not _is_wild(whole, rounded):
        return samples, whole
    exact = list(zip(rounded.exact, (y for _, y in pairs), strict=True))
    fitted = with_trends(samples._replace(pairs=exact).aside("collinear"), like)
    if not fitted.worse_than(whole) < CERTAIN:
        return samples, whole
    ripple = np.abs(np.vstack([u for u, _ in pairs]) - np.vstack(rounded.exact)).max(
        axis=0
    )
    some = np.flatnonzero(ripple > _PART * ripple.max())
    listed = ", ".join(telling.input(k) for k in some)
    telling.once(
        "rounded",
        f"The inputs {listed} add up, weighted, to a constant but for the rounding of "
        "their numbers: what each of them does is not identifiable, and the smallest "
        "solution was taken. Excite them independently, or leave one out.",
        RankWarning,
    )
    return samples._replace(pairs=exact), fitted


def _is_wild(fitted: LocalFit, rounded: Rounded) -> bool:
    """Whether a model makes far more of a ripple than of all that inputs do else."""
    model = fitted.evidence.state_space(fitted.model, 1.0)
    G = model.frequency_response(_LOOKED_AT)
    of_ripple = np.abs(G @ rounded.faint).max()
    return bool(of_ripple > _WILD * np.abs(G @ rounded.others).max())
