"""What can be a step of the method."""

from __future__ import annotations

from typing import Any

WITHOUT = ("aligned", "passthrough")  # what restructures without a structure

# Methods that the steps need, an example, and what else is allowed.
STEPS = {
    "local": (("fit",), "SubspaceLTI()", ()),
    "restructurer": (("fit_model",), "GrayBoxRestructurer(structure)", WITHOUT),
    "interpolator": (("fit", "predict"), "AutoLPV() or PolynomialLPV()", ()),
    "refiner": (("refine",), "OutputErrorLPV()", ()),
}


def check_step(name: str, step: Any) -> None:
    """Refuse what cannot be a step of the method, and say what can."""
    methods, example, other = STEPS[name]
    if step is None or (isinstance(step, str) and step in other):
        return
    got = f"{step!r}" if isinstance(step, str) else type(step).__name__
    if isinstance(step, type):
        got = f"the class {step.__name__}, not an instance"
    elif all(hasattr(step, method) for method in (*methods, "get_params")):
        if name != "local" or not hasattr(step, "fit_model"):
            return
        got += ", which is a `restructurer`"
    choice = ", ".join(["an estimator", *map(repr, other)]) + " or None"
    raise ValueError(
        f"`{name}` must be {choice}. Got {got}. Give an instance with the "
        f"method(s) {', '.join(methods)}, such as {example}."
    )
