"""What a file keeps of every class: its fields, and the form that each must have.

A form is text, and the documentation of the file as well: ``float[order, n_inputs]``
an array (sizes of one name are equal within an object), ``StateSpace[order]`` an object
of a class whose size of that name is the own one, ``text*n`` a list of n. A question
mark allows what is absent or None, and a minus sign is no field: what files do not
keep. Constructor arguments that no form tells of may be anything, and so may fitted
attributes: their names end in an underscore. A field of a file has the name of the
attribute, less an underscore in front.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator

from ...lpv.auto import AutoLPV
from ...lpv.interpolator import Interpolator
from ...lpv.model import LPVStateSpace
from ...lpv.polynomial import PolynomialLPV
from ...lpv.rational import RationalLPV
from ...lpv.spline import SplineLPV
from ...models.innovation import InnovationModel, NoiseModel
from ...models.statespace import StateSpace
from ...restructuring.estimator import GrayBoxRestructurer
from ...restructuring.identifiability import Identifiability
from ...structures.map import AffineMap, FixedMap, FunctionMap, RowsMap, StructureMap
from ...structures.mechanical import FluxMap, ImplicitMap
from ...structures.structure import GrayBoxStructure
from ...subspace.estimator import SubspaceLTI
from ...subspace.evidence.offsets import Offsets
from ...subspace.evidence.statistics import Evidence, Known
from ...subspace.fits.integrating import RateEvidence
from ..estimator import LocalLPVPipeline
from ..output_error import OutputErrorLPV

# Numbers that a loaded object may be put to, beyond those in the file: the derivatives
# of a structure that solves equations, the distances of a spline's nodes. 70 MB; 3000
# operating points, or 90 parameters of 300 states.
_MOST_ENTRIES = 9_000_000

_POINTS = {  # of all interpolators
    "scheduling_range_": "float[2, n_scheduling]",
    "n_features_in_": "size[n_scheduling]",
    "_single_parameter": "flag",
}
_MISFIT = {
    "rank_": "whole",
    "chi2_": "number",
    "degrees_of_freedom_": "whole",
    "weighted_": "flag",
}

FORMS: dict[type, dict[str, str]] = {
    StateSpace: {
        "A": "float[order, order]",
        "B": "float[order, n_inputs]",
        "C": "float[n_outputs, order]",
        "D": "float[n_outputs, n_inputs]",
        "sampling_time": "any?",
        "input_delay": "any",
        "input_names": "any?",
        "output_names": "any?",
        "units": "any?",
    },
    NoiseModel: {
        "A": "float[n_states, n_states]",
        "C": "float[n_outputs, n_states]",
        "K": "float[n_states, n_outputs]",
        "covariance": "float[n_outputs, n_outputs]",
    },
    InnovationModel: {
        "lti": "StateSpace[order, n_outputs]",
        "noise": "NoiseModel[n_outputs]",
        "gain": "float[order, n_outputs]?",
    },
    GrayBoxStructure: {
        "order": "whole",
        "map": "map",
        "parameter_names": "text*n_params",
        "initial": "float[n_params]?",
        "lower": "float[n_params]",
        "upper": "float[n_params]",
        "ranges": "float[2, n_params]",
        "is_mechanical": "flag",
    },
    AffineMap: {
        "offset": "float[n_rows, n_columns]",
        "basis": "float[n_params, n_rows, n_columns]",
    },
    ImplicitMap: {
        "M": "float[n_terms, n_dof, n_dof]",
        "N": "float[n_terms, n_dof, n_columns]",
        "W": "float[n_rows, n_dof]",
        "offset": "float[n_rows, n_columns]",
        "order": "whole",
        "name": "text",
    },
    FluxMap: {"equations": "ImplicitMap", "transposed": "ImplicitMap"},
    FixedMap: {"parent": "map", "values": "float[n_all]", "free": "bool[n_all]"},
    RowsMap: {"parent": "map", "rows": "int[n_rows]"},
    FunctionMap: {
        "function": "function",
        "derivatives": "function?",
        "dimensions": "whole*3",
        "typical": "float[n_params]",
        "takes_complex": "flag",
    },
    LPVStateSpace: {
        "structure": "GrayBoxStructure",
        "interpolator": "interpolator[n_scheduling]",
        "scheduling_range": "float[2, n_scheduling]",
        "scheduling_names": "any?",
        "identified_range": "any?",
        "bases": "any?",
        "input_delay": "any?",
        "offsets": "interpolator[n_scheduling]?",
        "rate_terms": "interpolator[n_scheduling]?",
        "covariance": "float[n_coefficients, n_coefficients]?",
        "input_names": "any?",
        "output_names": "any?",
        "units": "any?",
        "steady_start": "flag?",
        "hold": "text?",
    },
    PolynomialLPV: _POINTS
    | _MISFIT
    | {
        "powers_": "int[n_terms, n_scheduling]",
        "_chebyshev_coef": "float[n_terms, n_params]",
        "coef_": "float",
    },
    RationalLPV: _POINTS
    | _MISFIT
    | {
        "powers_": "int[n_terms, n_scheduling]",
        "numerator_": "float[n_terms, n_params]",
        "denominator_powers_": "int[n_below, n_scheduling]",
        "denominator_": "float[n_below]",
    },
    SplineLPV: _POINTS
    | {
        "n_points_": "size[n_points]",
        "_nodes": "float[n_points, n_scheduling]",
        "_theta": "float[n_points, n_params]",
    },
    AutoLPV: _POINTS
    | {
        "form_": "text",
        "best_estimator_": "interpolator[n_scheduling, n_params]",
        "selection_": "table",
    },
    Offsets: {
        "inputs": "float[n_experiments, n_inputs]",
        "outputs": "float[n_experiments, n_outputs]",
        "drifts": "float[n_experiments, n_outputs]",
        "constants": "float[n_experiments, n_outputs]",
        "n_samples": "int[n_experiments]",
        "differ": "flag",
    },
    Known: {
        "A": "float[order, order]",
        "B": "float[order, n_free]",
        "C": "float[n_outputs, order]",
        "D": "float[n_outputs, n_free]",
        "sizes": "int[n_sections]?",
        "noise": "NoiseModel[n_outputs]",
        "gain": "float[n_states, n_outputs]?",
        "covariance": "float[n_unknowns, n_unknowns]?",
        "input_scale": "float[n_free]",
        "output_scale": "float[n_outputs]",
        "basis": "float[n_inputs, n_free]",
        "direct": "bool[n_outputs, n_free]",
        "initial_states": "flag",
        "n_trend": "whole",
        "filter": "float[n_lags]",
        "weight": "float[n_outputs, n_outputs]",
        "input_delay": "int[n_inputs]",
        "turns": "float[n_turns]?",
    },
    RateEvidence: {
        "models": "StateSpace[n_inputs, n_outputs]*",
        "flags": "bool[n_outputs]",
        "n_inputs": "size[n_inputs]",
        "direct_std": "float[n_outputs, n_inputs]?",
    },
    SubspaceLTI: {
        "lti_": "StateSpace[order, n_inputs, n_outputs]",
        "method_": "text",
        "offset_": "text?",
        "order_": "whole",
        "horizon_": "whole",
        "singular_values_": "float[n_values]",
        "initial_states_": "float[n_starts, order]?",
        "input_delay_": "int[n_inputs]",
        "selection_": "table",
        "residual_": "number",
        "stability_loss_": "number",
        "input_offset_": "float[n_experiments, n_inputs]",
        "output_offset_": "float[n_experiments, n_outputs]",
        "output_drift_": "float[n_experiments, n_outputs]",
        "steady_start_": "flag?",
        "begun_state_": "float[order]?",
        "time_jitter_": "number",
        "n_outputs_": "size[n_outputs]",
        "n_features_in_": "whole",
        "_single_output": "flag",
        "_offsets": "Offsets[n_experiments, n_inputs, n_outputs]",
        "_evidence": "evidence[n_inputs, n_outputs]",
        "_stream": "-",
        "_stale": "-",
    },
    Identifiability: {
        "rank": "whole",
        "n_params": "whole",
        "condition": "number",
        "directions": "any",
        "sensitivities": "any?",
    },
    GrayBoxRestructurer: {
        "structure": "GrayBoxStructure?",
        "structure_": "GrayBoxStructure[n_params]",
        "params_": "float[n_params]",
        "lti_": "StateSpace[n_inputs, n_outputs]",
        "error_": "number",
        "relative_error_": "number",
        "objective_": "number",
        "lower_bound_": "number",
        "structural_floor_": "number",
        "remaining_error_": "number",
        "stationarity_": "number",
        "second_order_": "number",
        "fit_error_": "number",
        "n_iter_": "whole",
        "active_frequencies_": "float[n_active]",
        "start_params_": "float[n_params]",
        "dropped_feedthrough_": "float[n_outputs, n_inputs]",
        "convergence_": "text",
        "identifiability_": "Identifiability",
        "starts_": "table",
        "history_": "table",
        "params_covariance_": "float[n_params, n_params]?",
        "covariance_degrees_of_freedom_": "number?",
        "hinf_params_": "float[n_params]?",
        "hinf_error_": "number?",
        "chi2_": "number?",
        "degrees_of_freedom_": "any?",
        "p_value_": "number?",
    },
    OutputErrorLPV: {
        "lpv_": "LPVStateSpace[n_scheduling]",
        "scheduling_range_": "float[2, n_scheduling]",
        "sampling_time_": "number",
        "scheduling_names_": "any",
        "output_names_": "any?",
        "n_outputs_": "size[n_outputs]?",
        "n_features_in_": "whole?",
        "rate_": "flag",
        "coefficients_": "float[n_coefficients]",
        "coefficients_covariance_": "float[n_coefficients, n_coefficients]",
        "deviation_": "float[n_outputs]",
        "n_iter_": "whole",
        "initial_states_": "float[n_experiments, order]",
        "offsets_": "float[n_experiments, n_outputs]",
        "report_": "table",
        "output_errors_": "table?",
        "history_": "table",
        "_single_output": "flag?",
    },
    LocalLPVPipeline: {
        "memory": "-",
        "operating_points_": "float[n_points, n_scheduling]",
        "local_models_": "StateSpace[n_inputs, n_outputs]*n_points",
        "structured_models_": "StateSpace[n_inputs, n_outputs]*n_points",
        "restructurers_": "GrayBoxRestructurer[n_params]*",
        "parameters_": "table",
        "hinf_parameters_": "table",
        "parameters_covariance_": "float[n_points, n_params, n_params]",
        "parameters_std_": "table",
        "interpolator_": "interpolator[n_scheduling, n_params]",
        "lpv_": "LPVStateSpace[n_scheduling]",
        "input_delay_": "int[n_inputs]",
        "report_": "table",
        "parameter_report_": "table",
        "output_errors_": "table?",
        "scheduling_range_": "float[2, n_scheduling]",
        "sampling_time_": "number",
        "time_jitter_": "number",
        "step_times_": "any",
        "scheduling_names_": "any",
        "output_names_": "any",
        "n_outputs_": "size[n_outputs]",
        "n_features_in_": "whole",
        "refiner_": "OutputErrorLPV?",
        "_single_output": "flag",
    },
}

CLASSES = {kind.__name__: kind for kind in FORMS}

_GROUPS: dict[str, Any] = {
    "map": StructureMap,
    "interpolator": Interpolator,
    "evidence": Known | RateEvidence,
}

_ARRAYS = {"float": "f", "int": "i", "bool": "b", "complex": "c"}

_CHECKS: dict[str, Callable[[Any], bool]] = {
    "any": lambda value: True,
    "whole": lambda value: type(value) is int,
    "size": lambda value: type(value) is int,
    "number": lambda value: type(value) in (int, float),
    "flag": lambda value: type(value) is bool,
    "text": lambda value: type(value) is str,
    "function": callable,
    "table": lambda value: isinstance(value, pd.DataFrame),
    "object": lambda value: type(value) in CLASSES.values(),
}

_FORM = re.compile(r"(?P<kind>\w+|-)(\[(?P<sizes>.*)\])?(?P<many>\*\w*)?(?P<open>\?)?")


@dataclass(frozen=True)
class Form:
    """What a field may be, by the text of the table."""

    text: str
    fitted: bool = False  # of an estimator's field: it is no constructor argument

    @cached_property
    def _parts(self) -> dict[str, str | None]:
        found = _FORM.fullmatch(self.text)
        assert found is not None, self.text
        return found.groupdict()

    @property
    def kept(self) -> bool:
        """Whether files have such a field."""
        return self.text != "-"

    @property
    def needed(self) -> bool:
        """Whether every file has it."""
        return not self._parts["open"]

    @property
    def inner(self) -> Form:
        """That of the items of a list."""
        parts = self._parts
        sizes = f"[{parts['sizes']}]" if parts["sizes"] else ""
        return Form(f"{parts['kind']}{sizes}") if parts["many"] else Form("any")

    @property
    def _sizes(self) -> list[str]:
        return [name for name in re.split(r",\s*", self._parts["sizes"] or "") if name]

    def agree(
        self, kind: type, inner: dict[str, int], sizes: dict[str, int], place: str
    ) -> None:
        """Refuse an object of another class, or other sizes than those told so far."""
        wanted = str(self._parts["kind"])
        free = wanted in ("any", "object")
        group = object if free else (_GROUPS | CLASSES).get(wanted, type(None))
        if not issubclass(kind, group):
            raise ValueError(f"`{place}` must be {self.text}. Got {kind.__name__}")
        for name in self._sizes:
            if name in inner:
                self._bind(name, inner[name], sizes, place)

    def check(self, value: Any, place: str, sizes: dict[str, int]) -> None:
        """Refuse a value that is no object and has another form."""
        parts = self._parts
        if value is None and parts["open"]:
            return
        kind, fits = str(parts["kind"]), False
        if parts["many"]:
            fits = type(value) in (list, tuple)
            if fits and parts["many"] != "*":
                self._bind(parts["many"][1:], len(value), sizes, place)
        elif kind in _ARRAYS:
            fits = isinstance(value, np.ndarray) and value.dtype.kind == _ARRAYS[kind]
            if fits and parts["sizes"] is not None:
                fits = value.ndim == len(self._sizes)
                if fits:
                    for name, size in zip(self._sizes, value.shape, strict=True):
                        self._bind(name, size, sizes, place)
        elif kind in _CHECKS:
            fits = _CHECKS[kind](value)
            if fits and kind == "size":
                self._bind(self._sizes[0], value, sizes, place)
        if not fits:
            shown = getattr(value, "shape", "")
            raise ValueError(
                f"`{place}` must be {self.text}. Got {type(value).__name__} {shown}"
            )

    def _bind(self, name: str, size: int, sizes: dict[str, int], place: str) -> None:
        known = int(name) if name.isdigit() else sizes.setdefault(name, size)
        if size != known:
            raise ValueError(f"`{place}` must have {name} = {known}. Got {size}")


@cache
def _forms_of_class(kind: type) -> dict[str, Form]:
    arguments = inspect.signature(kind).parameters
    told = FORMS[kind]
    names = [*arguments, *(name for name in told if name not in arguments)]
    return {
        name: Form(told.get(name, "any?"), fitted=name not in arguments)
        for name in names
    }


def forms_of(kind: Any) -> dict[str, Form]:
    """Forms by the names of attributes: of a class, or of an object with all it has."""
    if isinstance(kind, type):
        return _forms_of_class(kind)
    own: type = type(kind)
    forms = _forms_of_class(own)
    if isinstance(kind, BaseEstimator):
        hasattr(kind, "lti_")  # a stream makes its model when it is asked for
        more = [n for n in vars(kind) if n.endswith("_") and not n.startswith("_")]
        forms = forms | {n: Form("any?", fitted=True) for n in more if n not in forms}
    return forms


def before_saving(value: Any) -> Any:
    """What stands for a value in a file."""
    return value.known() if isinstance(value, Evidence) else value


def after_loading(value: Any) -> Any:
    """What a value of a file stands for, once its parts are tried together.

    Nothing here takes much more memory than the value has.
    """
    _limit(value)
    if isinstance(value, Known):
        return value.evidence()
    if isinstance(value, GrayBoxStructure):
        _try_structure(value)
    elif isinstance(value, PolynomialLPV | RationalLPV) and hasattr(value, "powers_"):
        _check_powers(value.powers_)
        _check_powers(getattr(value, "denominator_powers_", value.powers_))
    elif isinstance(value, SplineLPV) and hasattr(value, "n_points_"):
        return value.with_coefficients(value.coefficients())  # the curve laid anew
    elif isinstance(value, LPVStateSpace):
        _try_lpv(value)
    elif isinstance(value, LocalLPVPipeline) and hasattr(value, "lpv_"):
        try:
            value.summary()
        except (KeyError, IndexError, TypeError, AttributeError) as error:
            raise ValueError(
                f"its tables do not tell what those of a pipeline do ({error!r})"
            ) from error
    return value


def _limit(value: Any) -> None:
    """Refuse what would take much more memory to build anew than its fields do."""
    entries = 0
    if isinstance(value, GrayBoxStructure) and value.basis is None:
        entries = value.n_params * math.prod(value.map.shape)
    elif isinstance(value, SplineLPV) and hasattr(value, "n_points_"):
        entries = value.n_points_**2 if value.n_features_in_ > 1 else 0
    if entries > _MOST_ENTRIES:
        raise ValueError(
            f"a {type(value).__name__} in a file must take {_MOST_ENTRIES} numbers to "
            f"build at most. Got {entries}."
        )


def _check_powers(powers: Any) -> None:
    """A term of a high degree comes with those of lower ones."""
    if powers.min(initial=0) < 0 or powers.max(initial=0) >= max(len(powers), 1):
        raise ValueError("the powers of its terms leave out lower ones")


def _try_structure(structure: GrayBoxStructure) -> None:
    names, n = structure.parameter_names, structure.order
    if len(set(names)) != len(names) or n < 0:
        raise ValueError("its parameters have equal names, or its order is negative")
    if min(structure.n_inputs, structure.n_outputs) < 1:
        raise ValueError("it has no inputs or outputs")
    if structure.implicit is not None and structure.implicit.order != n:
        raise ValueError("its equations are of another order")
    shape = (structure.n_params, *structure.map.shape)
    known = structure.basis
    if known is None:
        known = structure.jacobian(structure.reference)
    found = known.shape
    if found != shape:
        raise ValueError(f"its derivatives have shape {found}, its parameters {shape}")


def _try_lpv(model: LPVStateSpace) -> None:
    n, n_signals = model.order, model.n_inputs + model.n_outputs
    predicted = {
        "interpolator": model.structure.n_params,
        "offsets": n_signals + n,
        "rate_terms": model.n_scheduling * n**2,
    }
    for name, size in predicted.items():
        regressor = getattr(model, name)
        if regressor is None:
            continue
        place = regressor.scheduling_range_[:1]
        if hasattr(regressor, "feature_names_in_"):
            place = pd.DataFrame(place, columns=regressor.feature_names_in_)
        found = np.size(regressor.predict(place))
        if found != size:
            raise ValueError(f"`{name}` must predict {size} values. Got {found}")
