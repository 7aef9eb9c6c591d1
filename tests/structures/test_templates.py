"""Templates: affine expressions of parameter names, read without evaluation."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from lpvlearn import GrayBoxStructure

TEMPLATE = GrayBoxStructure.from_template


def one(entry, **options):
    """A structure of order 1 with an entry in A."""
    return TEMPLATE([[entry]], [[1]], [[1]], **options)


@pytest.mark.parametrize(
    "text, expected",
    [
        ("p", {"p": 1.0}),
        ("-p", {"p": -1.0}),
        ("+p", {"p": 1.0}),
        (" p ", {"p": 1.0}),
        ("2*p - 1", {"p": 2.0, "": -1.0}),
        ("p*2 + q/4", {"p": 2.0, "q": 0.25}),
        ("-(p - 3*(q + 1)) / 2", {"p": -0.5, "q": 1.5, "": 1.5}),
        ("2 * 3 / 4", {"": 1.5}),
        ("1e-3*p", {"p": 1e-3}),
        ("p + p", {"p": 2.0}),
        ("p - p + 5", {"": 5.0}),
        ("0 * p", {"": 0.0}),
        ("3", {"": 3.0}),
        ("größe", {"größe": 1.0}),
    ],
)
def test_affine_expressions(text, expected):
    structure = one(text)
    names = tuple(sorted(name for name in expected if name))
    assert structure.parameter_names == names
    values = {name: 3.0 + i for i, name in enumerate(names)}
    value = expected.get("", 0.0) + sum(expected[n] * values[n] for n in names)
    assert structure.model(values).A[0, 0] == pytest.approx(value)


@pytest.mark.parametrize(
    "text",
    [
        "p*q",
        "p**2",
        "1/p",
        "p/0",
        "p % 2",
        "sin(p)",
        "p.real",
        "p[0]",
        "__import__('os')",
        "lambda: 1",
        "[p]",
        "p if 1 else 2",
        "p == 1",
        "True",
        "None",
        "1j",
        "'p'",
        "",
        "p q",
        "p =",
        "2p",
        "p\0",
        "not p",
        "nan",
        "-inf",
        "1e400",
        "1" + 400 * "0",
        "(" * 3000 + "p" + ")" * 3000,
        "-" * 100_000 + "p",
    ],
)
def test_other_expressions_are_refused_by_cell(text):
    with pytest.raises(ValueError, match=r"`B\[1\]\[0\]` must be"):
        TEMPLATE([[0, 1], [2, 3]], [[0], [text]], [[1, 0]])


@pytest.mark.parametrize("entry", [None, 1j, [1], {}, np.nan, np.inf, b"p"])
def test_other_entries_are_refused_by_cell(entry):
    with pytest.raises(ValueError, match=r"`C\[0\]\[1\]` must be"):
        TEMPLATE([[0, 1], [2, 3]], [[0], [1]], [[1, entry]])


def test_names_are_in_natural_order():
    A = [["p10", "p2"], ["p1", "b"]]
    structure = TEMPLATE(A, [["a2"], ["a10"]], [[1, 0]], [["d_1"]])
    assert structure.parameter_names == ("a2", "a10", "b", "d_1", "p1", "p2", "p10")


def test_names_may_be_given():
    structure = one("2*a - b", parameter_names=["b", "a"])
    assert structure.parameter_names == ("b", "a")
    assert structure.model([1.0, 3.0]).A == 5.0


@pytest.mark.parametrize("names", [["a"], ["a", "a", "b"], ["a", "b", "c"], "ab"])
def test_given_names_must_be_those_of_the_template(names):
    with pytest.raises(ValueError, match="`parameter_names` must"):
        one("a + b", parameter_names=names)


def test_numpy_arrays_tables_and_integers_are_templates():
    A = np.array([[0, 1], ["-k", "-c"]], dtype=object)
    arrays = TEMPLATE(A, np.array([[0], [1]]), np.eye(2, dtype=int))
    strings = TEMPLATE(A.astype(str), [["0"], ["1"]], np.eye(2))
    tables = TEMPLATE(pd.DataFrame(A), ((0,), (1,)), pd.DataFrame(np.eye(2)))
    for structure in (arrays, strings, tables):
        assert structure.parameter_names == ("c", "k")
        model = structure.model([0.5, 4])
        assert_array_equal(model.A, [[0, 1], [-4, -0.5]])
        assert_array_equal(model.C, np.eye(2))


def test_entries_of_the_feedthrough_are_parameters():
    structure = TEMPLATE([[-1]], [[1, 0]], [[1]], [["d1", "2*d2"]])
    assert_array_equal(structure.model([3.0, 4.0]).D, [[3, 8]])


@pytest.mark.parametrize(
    "blocks, message",
    [
        (([[0, 1]], [[1]], [[1]]), r"`A` must have shape \(1, 1\).*\(1, 2\)"),
        (([[0]], [[1], [2]], [[1]]), r"`B` must have shape \(1, 1\).*\(2, 1\)"),
        (([[0]], [[1]], [[1, 2]]), r"`C` must have shape \(1, 1\).*\(1, 2\)"),
        (([[0]], [[1]], [[1]], [[1, 2]]), r"`D` must have shape \(1, 1\).*\(1, 2\)"),
        (([[0, 1], [2]], [[1]], [[1]]), r"`A`.*equal length.*\[2, 1\]"),
        (([0, 1], [[1]], [[1]]), "`A` must be a list of rows"),
        (([["k"]], [[1]], ["c"]), "`C` must be a list of rows"),
        (("k", [[1]], [[1]]), "`A` must be a list of rows"),
        ((1.0, [[1]], [[1]]), "`A` must be a list of rows"),
        (([[0]], np.ones(1), [[1]]), "`B` must be a list of rows"),
        (([], [], []), "at least one input and one output"),
        (([[0]], [[]], [[1]]), "at least one input and one output"),
        (([], [[1]], [], [["d"]]), r"`B` must have shape \(0, 1\)"),
    ],
)
def test_shapes_that_do_not_fit_are_named(blocks, message):
    with pytest.raises(ValueError, match=message):
        TEMPLATE(*blocks)


def test_templates_of_order_zero():
    for A, B, C in (([], [], []), (np.zeros((0, 0)), [], [[], []])):
        structure = TEMPLATE(A, B, C, [["g"], ["-2*g"]])
        assert_array_equal(structure.model([3.0]).D, [[3], [-6]])
