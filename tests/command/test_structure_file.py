"""Structures in files are those that the constructors make."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lpvlearn import GrayBoxStructure
from lpvlearn.command.structure_file import read_structure

from ..conftest import spring_structure
from .conftest import STRUCTURE


def read(folder, content, n_inputs=1, n_outputs=1):
    path = folder / ("a.toml" if isinstance(content, str) else "a.json")
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_structure(path, n_inputs, n_outputs)


def test_templates(tmp_path):
    structure, units = read(tmp_path, STRUCTURE)
    theta = np.array([1.0, 2.0, 3.0])
    expected = spring_structure().system_matrix(theta)
    assert_array_equal(structure.system_matrix(theta), expected)
    assert_array_equal(structure.lower, [-np.inf, -np.inf, 0.0])
    assert units == {"position": "m", "k": "1/s2"}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            {"form": "modal", "n_modes": 1, "n_real": 1},
            GrayBoxStructure.modal(1, 2, 3, 1),
        ),
        (
            {"form": "observable_canonical", "order": 4},
            GrayBoxStructure.observable_canonical(4, 2, 3),
        ),
        ({"form": "full", "order": 2}, GrayBoxStructure.full(2, 2, 3)),
        (
            {"form": "observable_canonical", "order": 4, "fix": {"a2_1": -1}},
            GrayBoxStructure.observable_canonical(4, 2, 3).fix({"a2_1": -1}),
        ),
    ],
)
def test_forms_count_the_signals_of_the_table(tmp_path, content, expected):
    structure = read(tmp_path, content, 2, 3).structure
    assert structure.parameter_names == expected.parameter_names
    theta = np.arange(1.0, structure.n_params + 1)
    assert_array_equal(structure.system_matrix(theta), expected.system_matrix(theta))


def test_equations_of_motion_with_ranges_and_bounds_on_one_side(tmp_path):
    equations = {"M": [["m"]], "D": [["c"]], "K": [["k"]], "F": [[1]]}
    known = {"bounds": {"m": [0.1, None]}, "ranges": {"k": [1, 9]}}
    structure = read(tmp_path, equations | known).structure
    expected = GrayBoxStructure.mechanical(**equations)
    theta = np.array([1.0, 2.0, 3.0])
    assert_array_equal(structure.system_matrix(theta), expected.system_matrix(theta))
    assert structure.lower[2] == 0.1 and structure.upper[2] == np.inf
    assert_array_equal(structure.ranges[:, 1], [1.0, 9.0])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("A = [[", "a.toml: "),
        ("A = [[1]]", "lacks B, C"),
        ({"form": "canonical"}, "`form` must be one of template, mechanical"),
        ({"form": "modal", "n_modes": 1, "order": 2}, "has order"),
        ({"form": "modal", "n_modes": "two"}, "a.json: `n_modes`"),
        ({"form": "full", "order": 1, "bounds": [1]}, "`bounds` must map names"),
        ({"form": "full", "order": 1, "bounds": {"q": [0, 1]}}, "Got 'q'"),
        ([1, 2], "a structure must be an object"),
        ({"A": [["__import__('os')"]], "B": [[1]], "C": [[1]]}, "`A[0][0]` must be"),
    ],
)
def test_what_is_none_tells_the_file_and_the_reason(tmp_path, content, words):
    with pytest.raises(ValueError, match="a.(toml|json): ") as told:
        read(tmp_path, content)
    assert words in str(told.value)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="the end of a structure's name"):
        read_structure(tmp_path / "a.yaml", 1, 1)
