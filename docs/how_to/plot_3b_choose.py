r"""
.. _how_to_choose:

Choose order, norm, basis, interpolation
========================================

The defaults choose by what the data support, and say what they chose. This page tells
when to choose yourself, and how to see whether it was right: by what happens at an
operating point that was left out.
"""

# %%
# Four experiments on a mass whose spring stiffens with kappa:

import pandas as pd
from sklearn.model_selection import cross_validate

from lpvlearn import (
    AutoLPV,
    ExperimentSplit,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
)
from lpvlearn.datasets import load_varying_spring
from lpvlearn.inspection import SingularValueDisplay

spring = load_varying_spring()
roles = {"scheduling": "kappa", "experiment": "run", "time": "time"}
cv = ExperimentSplit(
    "all",
    hold_out="operating_point",
    interior=True,
    scheduling="kappa",
    experiment="run",
)


def left_out(**choice):
    """R2 of the simulation at inner operating points that the fit did not see."""
    pipeline = LocalLPVPipeline(**choice, **roles)
    return cross_validate(pipeline, spring.X, spring.y, cv=cv)["test_score"]


# %%
# Order
# -----
# * **With a structure**, the order is its own.
# * **Without one**, ``order="auto"`` takes what all operating points together have
#   evidence for, as interpolation needs one order. Give ``SubspaceLTI(order=...)``
#   where physics tells it, or where the singular values show a gap elsewhere.
# * Too low an order shows in ``residual_tests`` (errors depend on past inputs), too
#   high a one in poles that jump from point to point
#   (:class:`~lpvlearn.inspection.PoleDisplay`).

one = spring.X["run"] == "run 2"
local = SubspaceLTI(inputs="force", time="time").fit(spring.X[one], spring.y[one])
print(f"order {local.order_}, horizon {local.horizon_}")
display = SingularValueDisplay.from_estimator(local)

# %%
# Norm
# ----
# * **Parameters as exact as the data allow**: nothing to give. ``efficient=True``
#   weighs the response by its uncertainty.
# * **The largest error at any frequency least**: ``efficient=False``, the paper's
#   H-infinity optimum; for robust control, and where a warning tells that the structure
#   lies far from the black box.
# * **The mean error over frequency least**: ``GrayBoxRestructurer(norm="h2")``.
# * **Some frequencies more than others**: its ``frequency_weight``.

choices = {
    "efficient": {},
    "H-infinity": {"efficient": False},
    "H2": {"restructurer": GrayBoxRestructurer(spring.structure, norm="h2")},
}
restructured = {
    name: LocalLPVPipeline(
        **{"restructurer": GrayBoxRestructurer(spring.structure), **choice}, **roles
    )
    .fit(spring.X, spring.y)
    .parameters_["k"]
    for name, choice in choices.items()
}
pd.DataFrame(restructured).assign(truth=lambda t: 40 + 20 * t.index**2).round(3)

# %%
# Basis
# -----
# * **Physical states** (a structure) wherever there is one: parameters have a meaning,
#   and few points do.
# * **Momenta, fluxes or heat** as states, not rates, where masses, inductances or
#   capacities follow the scheduling variable while it moves (:ref:`guide_state_basis`).
# * **None**: the default without a structure takes the observable canonical form where
#   a simple law carries it, and else ``"aligned"``, which turns balanced models to one
#   another. It takes more points than a structure does.
# * Never ``"passthrough"``: balanced models as they are, the paper's baseline.

structured = {"restructurer": GrayBoxRestructurer(spring.structure)}
pd.DataFrame(
    {
        "structure": left_out(**structured),
        "aligned": left_out(restructurer="aligned"),
    },
    index=["kappa 0.5 left out", "kappa 1 left out"],
).round(4)

# %%
# Interpolation
# -------------
# * ``AutoLPV``, the default, takes the simplest polynomial or fraction that meets the
#   points up to their noise, and a curve through the points where none does:
#   ``interpolator_.form_`` and ``selection_`` tell.
# * ``PolynomialLPV(d)`` or ``RationalLPV(d)`` where physics tells the form. Here it
#   does: a stiffness of a constant and a square.
# * ``SplineLPV`` for what has no form, such as a look-up table.
# * Beyond the points a polynomial goes astray: ``extrapolation="clip"``.

forms = [AutoLPV(), PolynomialLPV(1), PolynomialLPV(2), RationalLPV(1), SplineLPV()]
pd.DataFrame(
    {repr(form): left_out(**structured, interpolator=form) for form in forms},
    index=["kappa 0.5 left out", "kappa 1 left out"],
).T.round(4)

# %%
# A search does the same over all of them at once (:ref:`guide_tools`):
# ``GridSearchCV(pipeline, {"interpolator": forms}, cv=cv)``.
