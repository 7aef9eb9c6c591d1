"""Structures written in files, TOML or JSON: a template's cells or a form's name."""

from __future__ import annotations

import inspect
import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .. import GrayBoxStructure

_FORMS: dict[str, Callable[..., GrayBoxStructure]] = {
    "template": GrayBoxStructure.from_template,
    "mechanical": GrayBoxStructure.mechanical,
    "modal": GrayBoxStructure.modal,
    "observable_canonical": GrayBoxStructure.observable_canonical,
    "full": GrayBoxStructure.full,
}

_KNOWN = ("bounds", "ranges", "fix", "units")  # tables beside those of a form

# Where nothing must be told, the signals of the table are counted.
_COUNTS = ("n_inputs", "n_outputs")


class StructureFile(NamedTuple):
    """What a file tells."""

    structure: GrayBoxStructure
    units: dict[str, str]  # of signals and parameters, by name


def read_structure(path: Path, n_inputs: int, n_outputs: int) -> StructureFile:
    """Read a structure for tables with so many inputs and outputs.

    Raises a ValueError that names the file where it is none.
    """
    try:
        return _structure(_parsed(path), {"n_inputs": n_inputs, "n_outputs": n_outputs})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path.name}: {error}") from None


def _parsed(path: Path) -> dict[str, Any]:
    if path.suffix.lower() not in (".toml", ".json"):
        raise ValueError("the end of a structure's name must be .toml or .json.")
    if not path.is_file():
        raise ValueError("there is no such file.")
    text = path.read_text(encoding="utf-8-sig")
    found = tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    if not isinstance(found, dict):
        raise ValueError("a structure must be an object with A, B and C, or a form.")
    return found


def _structure(found: dict[str, Any], counts: Mapping[str, int]) -> StructureFile:
    form = found.pop("form", "mechanical" if "M" in found else "template")
    if not isinstance(form, str) or form not in _FORMS:
        raise ValueError(f"`form` must be one of {', '.join(_FORMS)}. Got {form!r}.")
    known = {name: _mapping(name, found.pop(name, {})) for name in _KNOWN}
    arguments = inspect.signature(_FORMS[form]).parameters
    needed = [
        name
        for name, argument in arguments.items()
        if argument.default is argument.empty and name not in (*_COUNTS, *found)
    ]
    unknown = [name for name in found if name not in arguments]
    if needed or unknown:
        what = f"lacks {', '.join(needed)}" if needed else f"has {', '.join(unknown)}"
        raise ValueError(
            f"a structure of the form {form!r} takes {', '.join(arguments)}, and the "
            f"tables {', '.join(_KNOWN)}. This one {what}."
        )
    counted = {name: n for name, n in counts.items() if name in arguments}
    structure = _FORMS[form](**counted | found)
    structure = structure.with_bounds(known["bounds"]).with_ranges(known["ranges"])
    if known["fix"]:
        structure = structure.fix(known["fix"])
    units = {name: str(unit) for name, unit in known["units"].items()}
    return StructureFile(structure, units)


def _mapping(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"`{name}` must map names to values. Got {value!r}.")
    return value
