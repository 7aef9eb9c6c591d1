"""Templates of gray-box structures: matrices of affine expressions of parameter names.

A cell is a number or a string such as ``"-p9"`` or ``"2*k - 1"``. It is parsed into its
coefficients; no code is ever evaluated. Canonical and modal forms are templates, too.

Templates come from strangers' files: the parser takes numbers, names, ``+ - * / ( )``
and nothing else, of a bounded length and depth, so that a cell ends at once in its
coefficients or in its error. (Python's own would normalise names, and warn.)
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import combinations
from keyword import iskeyword
from typing import Any, NoReturn
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from ..validation import (
    flag,
    has_one_axis,
    names_of,
    number,
    one_of,
    shown,
    whole_number,
)
from .map import AffineMap

Array = NDArray[np.float64]

Entry = float | str
Cells = list[list[Entry]]
SystemCells = tuple[Cells, Cells, Cells, Cells | None]  # A, B, C, D
Affine = dict[str, float]  # coefficient of every name; "" is the constant

_LONGEST = 10_000  # characters of a cell: thousands of terms
_DEEPEST = 100  # parentheses and signs within each other, far from the stack's end

_MOST_CELLS = 10**5  # of a form that is made: matrices of 300 x 300
_MOST_ENTRIES = 2 * 10**8  # of the matrices of all parameters: 1.6 GB

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[^\W\d]\w*)|(?P<sign>\*\*|[-+*/()])|(?P<end>$)|(?P<other>.))",
    re.DOTALL,
)


def affine_system(
    A: Any, B: Any, C: Any, D: Any, parameter_names: Sequence[str] | None
) -> tuple[int, AffineMap, list[str]]:
    """Read templates of A, B, C, D: the order, the map, and the parameter names."""
    n, rows = system_cells(A, B, C, D)
    offset, basis, names = affine_arrays(rows, parameter_names)
    return n, AffineMap(offset, basis), names


def system_cells(A: Any, B: Any, C: Any, D: Any) -> tuple[int, list[list[Affine]]]:
    """The order, and the cells of ``[[A, B], [C, D]]``."""
    given = {"A": A, "B": B, "C": C}
    cells = {name: parse_cells(name, block) for name, block in given.items()}
    n = len(cells["A"])
    if D is not None:
        cells["D"] = parse_cells("D", D)
        if n == 0:  # a pure gain: the shapes come from D
            cells["C"] = cells["C"] or [[] for _ in cells["D"]]
    p = len(cells["C"])
    first = cells["B"] or cells.get("D")
    m = len(first[0]) if first else 0
    if 0 in (m, p):
        raise ValueError(
            "a structure needs at least one input and one output; a pure gain takes "
            f"them from `D`. Got {m} inputs and {p} outputs."
        )
    zero: Affine = {"": 0.0}
    cells.setdefault("D", [[zero] * m for _ in range(p)])
    expected = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}
    check_shapes(cells, expected, "the other matrices")
    rows = [a + b for a, b in zip(cells["A"], cells["B"], strict=True)]
    rows += [c + d for c, d in zip(cells["C"], cells["D"], strict=True)]
    return n, rows


def check_shapes(
    cells: dict[str, list[list[Affine]]], expected: dict[str, tuple[int, int]], to: str
) -> None:
    """Refuse blocks that do not fit to others; an empty one has no columns."""
    for name, block in cells.items():
        shape = (len(block), len(block[0]) if block else 0)
        if shape != expected[name] and (block or expected[name][0]):
            raise ValueError(
                f"`{name}` must have shape {expected[name]} to fit {to}. Got {shape}."
            )


def affine_arrays(
    rows: Sequence[Sequence[Affine]], parameter_names: Sequence[str] | None
) -> tuple[Array, Array, list[str]]:
    """The constant part, the part of every parameter, and the parameter names."""
    used = {name for row in rows for entry in row for name in entry if name}
    _check_alike(used)
    names = _ordered_names(used, parameter_names)
    size = len(names) * sum(map(len, rows))
    if size > _MOST_ENTRIES:
        raise ValueError(
            f"`parameter_names` must be fewer: {len(names)} parameters in matrices of "
            f"{sum(map(len, rows))} entries take {8 * size:.0e} bytes. Got more than "
            f"{8 * _MOST_ENTRIES:.0e}; write the structure with from_function."
        )

    def coefficients(name: str) -> list[list[float]]:
        return [[entry.get(name, 0.0) for entry in row] for row in rows]

    offset = np.array(coefficients(""))
    basis = np.array([coefficients(name) for name in names])
    return offset, basis.reshape(-1, *offset.shape), names


def _check_alike(names: set[str]) -> None:
    """Refuse names that are told apart by their code points alone."""
    alike: dict[str, str] = {}
    for name in sorted(names):
        other = alike.setdefault(normalize("NFKC", name), name)
        if other != name:
            raise ValueError(
                f"`parameter_names` must look different. Got {other!r} "
                f"({ascii(other)}) and {name!r} ({ascii(name)}) in the template; write "
                "them alike, or rename one."
            )


def _ordered_names(used: set[str], given: Sequence[str] | None) -> list[str]:
    """The parameter names in the given order, else natural order."""
    if given is None:
        return sorted(used, key=_natural)
    given = names_of("parameter_names", given)
    if set(given) != used:
        difference = sorted(map(str, set(given) ^ used))
        raise ValueError(
            "`parameter_names` must name each parameter of the template once. "
            f"Got {given}; differing: {difference}."
        )
    return given


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Sorting key by which p2 comes before p10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [
        (False, len(t.lstrip("0")), t.lstrip("0"))
        if t[0] in "0123456789"
        else (True, 0, t)
        for t in parts
    ]


def parse_cells(name: str, block: Any) -> list[list[Affine]]:
    """Parse a matrix of template entries; errors name the cell."""
    if hasattr(block, "__array__"):  # arrays and tables
        block = np.asarray(block, dtype=object).tolist()
    if (
        isinstance(block, str)
        or not isinstance(block, Sequence)
        or any(isinstance(row, str) or not hasattr(row, "__iter__") for row in block)
    ):
        raise ValueError(f"`{name}` must be a list of rows. Got {shown(block)}.")
    rows = [list(row) for row in block]
    if any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(
            f"`{name}` must be a list of rows of equal length. "
            f"Got row lengths {[len(row) for row in rows]}."
        )
    return [
        [_entry(f"{name}[{i}][{j}]", entry) for j, entry in enumerate(row)]
        for i, row in enumerate(rows)
    ]


def _entry(cell: str, entry: Any) -> Affine:
    if isinstance(entry, str):
        try:
            affine = _Parser(entry).expression_to_end()
        except ValueError as error:
            raise ValueError(
                f"`{cell}` must be a number or an affine expression of parameter names "
                f"such as '-p9' or '2*k - 1'. Got {shown(entry)} ({error})."
            ) from None
    else:
        rule = "a finite number or an affine expression of parameter names"
        affine = {"": number(cell, entry, rule)}
    if not np.isfinite(list(affine.values())).all():
        raise ValueError(f"`{cell}` must be finite. Got {shown(entry)}.")
    # What cancels is not a parameter of the cell
    return {name: c for name, c in affine.items() if c != 0 or name == ""}


class _Parser:
    """Coefficients of an affine expression, by recursive descent."""

    def __init__(self, text: str) -> None:
        if len(text) > _LONGEST:
            raise ValueError(f"{len(text)} characters, more than {_LONGEST}")
        self.tokens = _TOKEN.finditer(text)
        self.depth = 0
        self.next()

    def next(self) -> None:
        token = next(self.tokens)
        self.kind, self.text = str(token.lastgroup), token[0].strip()

    def expression_to_end(self) -> Affine:
        found = self.expression()
        if self.kind != "end":
            self.refuse()
        return found

    def refuse(self) -> NoReturn:
        raise ValueError(
            "not affine; use GrayBoxStructure.from_function"
            if self.text in ("(", "**") or self.kind == "other"
            else f"{shown(self.text)} is out of place"
            if self.text
            else "it ends early"
        )

    def expression(self) -> Affine:
        total = self.term()
        while self.text in ("+", "-"):
            sign = -1.0 if self.text == "-" else 1.0
            self.next()
            for name, c in self.term().items():
                total[name] = total.get(name, 0.0) + sign * c
        return total

    def term(self) -> Affine:
        product = self.factor()
        while self.text in ("*", "/"):
            operator = self.text
            self.next()
            other = self.factor()
            if operator == "*" and set(product) <= {""}:
                product, other = other, product
            if not set(other) <= {""}:
                raise ValueError("not affine; use GrayBoxStructure.from_function")
            by = other[""]
            if operator == "/" and by == 0:
                raise ValueError("division by zero")
            product = {
                name: c / by if operator == "/" else c * by
                for name, c in product.items()
            }
        return product

    def factor(self) -> Affine:
        kind, text = self.kind, self.text
        if kind == "number":
            self.next()
            return {"": float(text)}
        if kind == "name":
            number = text.lower() in ("nan", "inf", "infinity")
            if number or iskeyword(text) or not text.isidentifier():
                raise ValueError(f"{shown(text)} is not a parameter name")
            self.next()
            return {text: 1.0}
        if text not in ("+", "-", "("):
            self.refuse()
        self.depth += 1
        if self.depth > _DEEPEST:
            raise ValueError(f"nested more than {_DEEPEST} deep")
        self.next()
        if text == "(":
            found = self.expression()
            if self.text != ")":
                self.refuse()
            self.next()
        else:
            sign = -1.0 if text == "-" else 1.0
            found = {name: sign * c for name, c in self.factor().items()}
        self.depth -= 1
        return found


def observable_canonical_cells(
    order: int,
    n_inputs: int,
    n_outputs: int,
    feedthrough: bool,
    indices: Sequence[int] | None,
) -> SystemCells:
    """A, B, C, D of the form, see `GrayBoxStructure.observable_canonical`."""
    _, B, C, D = full_cells(order, n_inputs, n_outputs, feedthrough)
    A: Cells = [[0.0] * order for _ in range(order)]
    first = 0
    for i, length in enumerate(_chains(order, n_outputs, indices)):
        if length == 0:
            continue  # its row of C stays free
        C[i] = [1.0 if j == first else 0.0 for j in range(order)]
        last = first + length - 1
        for k in range(first, last):
            A[k][k + 1] = 1.0
        A[last] = [f"a{last + 1}_{j + 1}" for j in range(order)]
        first += length
    return A, B, C, D


def generic_indices(order: int, n_outputs: int) -> Iterator[tuple[int, ...]]:
    """Lengths of the chains of states that outputs head, those of the form first.

    They differ by one at most.

    >>> list(generic_indices(3, 2)), list(generic_indices(4, 2))
    ([(2, 1), (1, 2)], [(2, 2)])
    """
    each, n_longer = divmod(order, n_outputs)
    for longer in combinations(range(n_outputs), n_longer):
        yield tuple(each + (i in longer) for i in range(n_outputs))


def _chains(order: int, n_outputs: int, indices: Sequence[int] | None) -> list[int]:
    """Lengths of the chains of states, of every output."""
    if indices is None:
        indices = next(generic_indices(order, n_outputs))
    lengths = []
    if has_one_axis(indices):
        lengths = [whole_number("indices", length, 0) for length in indices]
    if len(lengths) != n_outputs or sum(lengths) != order:
        raise ValueError(
            f"`indices` must be a list of a number for each of {n_outputs} output(s), "
            f"which add up to the order, {order}. Got {shown(indices)}."
        )
    return lengths


def full_cells(
    order: int, n_inputs: int, n_outputs: int, feedthrough: bool
) -> SystemCells:
    """A, B, C, D whose entries are all parameters: ``a1_1, a1_2, ...``."""
    n, feedthrough = whole_number("order", order, 0), flag("feedthrough", feedthrough)
    if n == 0 and not feedthrough:
        raise ValueError(
            "`feedthrough` must be True for order 0: a pure gain has no other "
            "parameters. Got False."
        )
    m = whole_number("n_inputs", n_inputs, 1)
    p = whole_number("n_outputs", n_outputs, 1)
    if (n + p) * (n + m) > _MOST_CELLS:
        raise ValueError(
            f"`order`, `n_inputs` and `n_outputs` must make at most {_MOST_CELLS} "
            f"entries. Got {n}, {m} and {p}."
        )
    D = _full_block("d", p, m) if feedthrough else None
    return _full_block("a", n, n), _full_block("b", n, m), _full_block("c", p, n), D


def integrated_cells(blocks: SystemCells, outputs: Sequence[int]) -> SystemCells:
    """Blocks of a system some of whose outputs are the integrals of those of another.

    ``A' = [[A, 0], [C_i, 0]]``, ``B' = [[B], [D_i]]``; the last states are outputs i.
    """
    A, B, C, D = blocks
    if not has_one_axis(outputs):
        raise ValueError(
            "`integrating` must be a list of positions of outputs. Got "
            f"{shown(outputs)}."
        )
    places = [whole_number("integrating", i, 0, len(C) - 1) for i in outputs]
    outputs = list(dict.fromkeys(places))
    n_inputs = len((B or D or [[]])[0])
    free = D or [[0.0] * n_inputs for _ in C]
    behind = [0.0] * len(outputs)
    rows: Cells = [[*row, *behind] for row in (*A, *(C[i] for i in outputs))]
    seen: Cells = [[*row, *behind] for row in C]
    for place, i in enumerate(outputs):
        seen[i] = [0.0] * len(rows)
        seen[i][len(A) + place] = 1.0
    direct: Cells = [
        [0.0] * n_inputs if i in outputs else row for i, row in enumerate(free)
    ]
    return rows, [*B, *(free[i] for i in outputs)], seen, direct if D else None


def _full_block(letter: str, rows: int, columns: int) -> Cells:
    return [[f"{letter}{i + 1}_{j + 1}" for j in range(columns)] for i in range(rows)]


def modal_cells(
    n_modes: int,
    n_inputs: int,
    n_outputs: int,
    n_real: int,
    feedthrough: bool,
    normalize: str,
) -> SystemCells:
    """A, B, C, D of the real modal form, see `GrayBoxStructure.modal`."""
    n_modes = whole_number("n_modes", n_modes, 0)
    n_real = whole_number("n_real", n_real, 0)
    feedthrough = flag("feedthrough", feedthrough)
    if n_modes == n_real == 0:
        raise ValueError("`n_modes` or `n_real` must be at least 1. Got 0 and 0.")
    one_of("normalize", normalize, ("input", "output"))
    order = 2 * n_modes + n_real
    _, B, C, D = full_cells(order, n_inputs, n_outputs, feedthrough)
    A: Cells = [[0.0] * order for _ in range(order)]
    for i in range(n_modes):
        k = 2 * i
        A[k][k + 1] = 1.0
        A[k + 1][k : k + 2] = [f"-w2_{i + 1}", f"-d_{i + 1}"]
    for i in range(n_real):
        k = 2 * n_modes + i
        A[k][k] = f"-r_{i + 1}"
    for k in range(order):
        second = k < 2 * n_modes and k % 2 == 1
        if normalize == "input":  # [0, 1] for a mode, 1 for a real pole
            B[k][0] = 1.0 if second or k >= 2 * n_modes else 0.0
        else:  # [1, 0] and 1
            C[0][k] = 0.0 if second else 1.0
    return A, B, C, D
