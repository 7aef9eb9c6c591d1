"""Templates: affine expressions of parameter names; canonical and modal forms."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure, StateSpace

from .conftest import OMEGA, rank

TEMPLATE = GrayBoxStructure.from_template
MODAL = GrayBoxStructure.modal


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


# -- canonical forms -------------------------------------------------------------


def canonical_parameters(model, structure, lengths=None):
    """Parameters of the canonical form of a model, by linear algebra alone.

    In the canonical basis the states are rows ``C_i A^k`` of the observability matrix:
    the change of basis is known, and every entry of the form can be read off.
    """
    n, p = model.order, model.n_outputs
    lengths = lengths or [n // p + (i < n % p) for i in range(p)]
    T = np.array(
        [
            model.C[i] @ np.linalg.matrix_power(model.A, k)
            for i in range(p)
            for k in range(lengths[i])
        ]
    )
    canonical = model.transform(T)
    S = np.block([[canonical.A, canonical.B], [canonical.C, canonical.D]])
    theta = np.array(
        [
            S[tuple(np.argwhere(entry)[0])]
            for entry in structure.jacobian(np.zeros(structure.n_params))
        ]
    )
    return theta, S


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize(
    "order, n_inputs, n_outputs",
    [(1, 1, 1), (3, 1, 1), (4, 2, 2), (5, 2, 2), (5, 1, 3), (2, 1, 3), (1, 2, 2)],
)
def test_canonical_form_holds_every_generic_model(
    order, n_inputs, n_outputs, feedthrough
):
    rng = np.random.default_rng(order)
    A = rng.normal(size=(order, order)) - 2 * np.eye(order)
    B, C = rng.normal(size=(order, n_inputs)), rng.normal(size=(n_outputs, order))
    D = rng.normal(size=(n_outputs, n_inputs)) * feedthrough
    model = StateSpace(A, B, C, D)
    structure = GrayBoxStructure.observable_canonical(
        order, n_inputs, n_outputs, feedthrough
    )
    # as many parameters as a transfer function of that order has coefficients
    assert structure.n_params == order * (n_inputs + n_outputs) + D.size * feedthrough
    theta, S = canonical_parameters(model, structure)
    assert_allclose(structure.system_matrix(theta), S, atol=1e-9 * np.abs(S).max())
    omega = np.array([0.0, 0.4, 3.0, np.inf])
    assert_allclose(
        structure.model(theta).frequency_response(omega),
        model.frequency_response(omega),
        atol=1e-9,
    )


@pytest.mark.parametrize("indices", [(1, 2), (0, 3), (3, 0)])
def test_chains_of_a_canonical_form_are_as_long_as_asked(indices):
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 3)) - 2.0 * np.eye(3)
    model = StateSpace(A, rng.normal(size=(3, 1)), rng.normal(size=(2, 3)))
    structure = GrayBoxStructure.observable_canonical(3, 1, 2, indices=indices)
    found = structure.model(canonical_parameters(model, structure, indices)[0])
    omega = np.array([0.0, 0.4, 3.0])
    wanted = model.frequency_response(omega)
    assert_allclose(found.frequency_response(omega), wanted, atol=1e-9)
    for output, length in enumerate(indices):  # each the derivative of the one before
        chain = [found.C[output] @ np.linalg.matrix_power(found.A, k) for k in range(3)]
        assert_array_equal(np.isin(chain[:length], [0.0, 1.0]), True)


@pytest.mark.parametrize("indices", [(1, 1), (1, 1, 1), (-1, 4), (1.5, 1.5), 3, "12"])
def test_chains_that_do_not_add_up_are_refused(indices):
    with pytest.raises(ValueError, match="`indices` must be"):
        GrayBoxStructure.observable_canonical(3, 1, 2, indices=indices)


@pytest.mark.parametrize("make", ["observable_canonical", "full"])
def test_order_zero_is_a_pure_gain(make):
    structure = getattr(GrayBoxStructure, make)(0, 2, 3, feedthrough=True)
    assert (structure.order, structure.n_inputs, structure.n_outputs) == (0, 2, 3)
    names = ("d1_1", "d1_2", "d2_1", "d2_2", "d3_1", "d3_2")
    assert structure.parameter_names == names
    model = structure.model(np.arange(6.0))
    assert_array_equal(model.D, np.arange(6.0).reshape(3, 2))
    assert_array_equal(model.simulate([[1, 0]], sampling_time=1.0), [[0, 2, 4]])
    with pytest.raises(ValueError, match="`feedthrough` must be True for order 0"):
        getattr(GrayBoxStructure, make)(0, 2, 3, feedthrough=False)


@pytest.mark.parametrize("feedthrough", [False, True])
def test_full_structure_holds_its_entries_row_by_row(feedthrough):
    structure = GrayBoxStructure.full(3, 2, 1, feedthrough)
    rng = np.random.default_rng(0)
    blocks = [rng.normal(size=s) for s in ((3, 3), (3, 2), (1, 3), (1, 2))]
    if not feedthrough:
        blocks[3][:] = 0
    used = blocks if feedthrough else blocks[:3]
    theta = np.concatenate([block.ravel() for block in used])
    for found, expected in zip(structure.matrices(theta), blocks, strict=True):
        assert_array_equal(found, expected)


@pytest.mark.parametrize("order", [0, 2])
def test_outputs_that_integrate_are_those_of_the_full_form_over_s(order):
    rates = GrayBoxStructure.full(order, 2, 3)
    theta = np.random.default_rng(1).normal(size=rates.n_params)
    structure = GrayBoxStructure.full(order, 2, 3, integrating=[2, 0])
    assert structure.parameter_names == rates.parameter_names
    omega = np.array([0.3, 4.0])
    expected = rates.model(theta).frequency_response(omega)
    expected[:, [0, 2]] /= 1j * omega[:, None, None]
    found = structure.model(theta).frequency_response(omega)
    assert_allclose(found, expected, rtol=1e-12)
    assert structure.order == order + 2
    with pytest.raises(ValueError, match="`integrating`.*2"):
        GrayBoxStructure.full(order, 2, 3, integrating=[3])


@pytest.mark.parametrize("make", ["observable_canonical", "full"])
@pytest.mark.parametrize(
    "dimensions, name",
    [
        ((-1, 1, 1), "order"),
        ((2.0, 1, 1), "order"),
        ((True, 1, 1), "order"),
        ((2, 0, 1), "n_inputs"),
        ((2, 1, 0), "n_outputs"),
        ((2, 1, "1"), "n_outputs"),
    ],
)
def test_dimensions_must_be_whole_numbers(make, dimensions, name):
    with pytest.raises(ValueError, match=f"`{name}` must be an integer"):
        getattr(GrayBoxStructure, make)(*dimensions)


# -- modal -----------------------------------------------------------------------


def modal_parameters(model, structure, normalize):
    """Parameters of the modal form of a model, by eigenvectors alone."""
    poles, V = np.linalg.eig(model.A)
    Bt, Ct = np.linalg.solve(V, model.B), model.C @ V
    values = {}
    pairs = [i for i in range(len(poles)) if poles[i].imag > 0]
    reals = [i for i in range(len(poles)) if poles[i].imag == 0]
    n_modes = (structure.order - len(reals)) // 2
    assert n_modes == len(pairs)
    for k, i in enumerate(pairs):
        values[f"w2_{k + 1}"] = abs(poles[i]) ** 2
        values[f"d_{k + 1}"] = -2 * poles[i].real
        # companion block: right eigenvector [1, lambda]; scaled by a complex number
        lam = poles[i]
        V0 = np.array([[1, 1], [lam, lam.conj()]])
        if normalize == "input":  # V0 diag(s) Bt = [0, 1] for the first input
            s = np.linalg.solve(V0, [0, 1])[0] / Bt[i, 0]
        else:  # Ct diag(1/s) V0^-1 = [1, 0] for the first output
            s = Ct[0, i] / 1.0
        b, c = s * Bt[i], Ct[:, i] / s
        B2 = (V0 @ np.array([b, b.conj()])).real
        C2 = (np.stack([c, c.conj()], 1) @ np.linalg.inv(V0)).real
        for row in range(2):
            for j in range(model.n_inputs):
                values[f"b{2 * k + row + 1}_{j + 1}"] = B2[row, j]
            for j in range(model.n_outputs):
                values[f"c{j + 1}_{2 * k + row + 1}"] = C2[j, row]
    for k, i in enumerate(reals):
        s = 1 / Bt[i, 0].real if normalize == "input" else Ct[0, i].real
        values[f"r_{k + 1}"] = -poles[i].real
        state = 2 * n_modes + k + 1
        for j in range(model.n_inputs):
            values[f"b{state}_{j + 1}"] = s * Bt[i, j].real
        for j in range(model.n_outputs):
            values[f"c{j + 1}_{state}"] = Ct[j, i].real / s
    for i, j in np.ndindex(model.D.shape):
        values[f"d{i + 1}_{j + 1}"] = model.D[i, j]
    return np.array([values[name] for name in structure.parameter_names])


@pytest.mark.parametrize("normalize", ["input", "output"])
@pytest.mark.parametrize(
    "n_modes, n_real, m, p, feedthrough",
    [(1, 0, 1, 1, False), (2, 0, 2, 3, False), (1, 2, 2, 2, True), (0, 1, 1, 2, False)],
)
def test_modal_form_holds_every_diagonalizable_model(
    n_modes, n_real, m, p, feedthrough, normalize
):
    rng = np.random.default_rng(n_modes + 10 * n_real)
    n = 2 * n_modes + n_real
    A = np.zeros((n, n))
    for i in range(n_modes):
        s, w = rng.uniform(0.1, 1), rng.uniform(1, 9)
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[-s, w], [-w, -s]]
    for i in range(2 * n_modes, n):
        A[i, i] = -rng.uniform(0.2, 5)
    D = rng.normal(size=(p, m)) * feedthrough
    model = StateSpace(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), D)
    model = model.transform(rng.normal(size=(n, n)))
    structure = MODAL(n_modes, m, p, n_real, feedthrough, normalize=normalize)
    assert structure.n_params == n * (m + p) + D.size * feedthrough
    theta = modal_parameters(model, structure, normalize)
    G = model.frequency_response(OMEGA)
    error = structure.model(theta).frequency_response(OMEGA) - G
    assert np.abs(error).max() < 1e-10 * np.abs(G).max()
    assert rank(structure, theta) == structure.n_params


def test_modal_parameters_are_poles():
    structure = MODAL(1, n_real=1)
    theta = dict.fromkeys(structure.parameter_names, 1.0)
    poles = structure.model(theta | {"w2_1": 9.0, "d_1": 0.5, "r_1": 7.0}).poles()
    assert_allclose(np.prod(poles[:2]).real, 9.0)
    assert_allclose(poles[:2].sum().real, -0.5)
    assert_allclose(poles[2], -7.0)


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        ((0,), {}, "`n_modes` or `n_real` must be at least 1"),
        ((-1,), {}, "`n_modes` must be an integer"),
        ((1, 0), {}, "`n_inputs` must be an integer"),
        ((1, 1, 1.5), {}, "`n_outputs` must be an integer"),
        ((1, 1, 1, -2), {}, "`n_real` must be an integer"),
        ((1,), {"normalize": "both"}, "`normalize` must be 'input' or 'output'"),
    ],
)
def test_wrong_modal_forms_are_explained(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        MODAL(*arguments, **options)
