"""The matrices of an LPV model as polynomials or fractions of the scheduling variables.

Where the matrices are affine in the parameters, and these are polynomials, or fractions
with one denominator, so are the matrices. All are changed from Chebyshev polynomials on
the range of the points, in which they are fitted, to powers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from ..exceptions import VersionedPickle, warn
from ..models.scheduling_range import domains
from ..models.statespace import StateSpace
from ..models.system_matrix import blocks
from ..structures.structure import GrayBoxStructure
from ..validation import flag, place
from .polynomial import PolynomialLPV, conversion_to
from .rational import RationalLPV

Array = NDArray[np.float64]
Powers = NDArray[np.intp]

# Rounding errors of coefficients, by how many times larger than the range a variable is
# to the power of the degree, from which they are told of: six digits are left.
_LOST = 1e-6

_GRID = "Take frozen models: grid(points), to_control(points), to_mat(path, points)."


@dataclass(frozen=True, eq=False, repr=False)
class MatrixCoefficients(VersionedPickle):
    """Coefficients of the matrices of an LPV model.

    ``A(kappa) = sum_k A[k] t_k(kappa) / d(kappa)``, B, C and D alike, with the products
    of powers ``t_k = prod_j ((kappa_j - centre_j) / half_width_j) ** powers[k, j]`` and
    ``d = sum_k denominator[k] t_k``. Of one scheduling variable, ``A[k]`` belongs to
    its k-th power. Offsets of the model are left out.

    Attributes
    ----------
    A, B, C, D : ndarray of shape (n_terms, rows, columns)
    powers : ndarray of int, shape (n_terms, n_scheduling)
    denominator : ndarray of shape (n_terms,)
        1, 0, 0, ... of a polynomial.
    centre, half_width : ndarray of shape (n_scheduling,)
        0 and 1, unless the variables are normalized.
    scheduling_names : tuple
    input_delay : ndarray of shape (n_inputs,)
        Seconds.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    powers: Powers
    denominator: Array
    centre: Array
    half_width: Array
    scheduling_names: tuple[Any, ...]
    input_delay: Array

    def __repr__(self) -> str:
        kind = "rational" if self.denominator[1:].any() else "polynomial"
        return (
            f"MatrixCoefficients({kind}, n_terms={len(self.powers)}, "
            f"n_scheduling={self.powers.shape[1]})"
        )

    def at(self, kappa: ArrayLike) -> StateSpace:
        """The frozen model at one scheduling value, shape (n_scheduling,)."""
        unit = place("kappa", kappa, len(self.centre)) - self.centre
        terms = np.prod((unit / self.half_width) ** self.powers, axis=1)
        terms = terms / (terms @ self.denominator)
        A, B, C, D = (np.tensordot(terms, M, 1) for M in self._matrices)
        return StateSpace(A, B, C, D, input_delay=self.input_delay)

    def table(self) -> pd.DataFrame:
        """Coefficients of every entry that is not zero: a row each, a column per term.

        Returns
        -------
        DataFrame
            Rows by matrix, row and column (from 0), the last one the denominator of a
            fraction. Entries that do not depend on the scheduling variables stand in
            the column "1"; in a fraction in "constant", without the denominator.
        """
        rational = bool(self.denominator[1:].any())
        rows: dict[tuple[str, int, int], Array] = {}
        for name, M in zip("ABCD", self._matrices, strict=True):
            for i, j in np.argwhere(M.any(axis=0)).tolist():
                rows[name, i, j] = M[:, i, j]
        constant = {}
        if rational:
            lead = np.abs(self.denominator).argmax()
            for key, row in rows.items():
                value = row[lead] / self.denominator[lead]
                if np.array_equal(row, value * self.denominator):
                    constant[key], rows[key] = value, np.zeros_like(row)
            rows["denominator", 0, 0] = self.denominator
        index = pd.MultiIndex.from_tuples(rows, names=["matrix", "row", "column"])
        table = pd.DataFrame(
            list(rows.values()), index, [*map(self._term, self.powers)]
        )
        if constant:
            table.insert(0, "constant", pd.Series(constant).reindex(index).fillna(0.0))
        return table

    @property
    def _matrices(self) -> tuple[Array, Array, Array, Array]:
        return self.A, self.B, self.C, self.D

    def _term(self, powers: Powers) -> str:
        factors = [
            f"{name}^{power}" if power > 1 else str(name)
            for name, power in zip(self.scheduling_names, powers, strict=True)
            if power
        ]
        return "*".join(factors) or "1"


def matrix_coefficients(
    structure: GrayBoxStructure,
    interpolator: Any,
    T: Array | None,
    names: tuple[Any, ...],
    input_delay: Array,
    *,
    normalized: bool,
) -> MatrixCoefficients:
    """Coefficients in powers of the scheduling variables.

    In the basis ``T x`` of the structure's state x, None for one that follows the
    scheduling variables. `normalized` maps these to [-1, 1].
    """
    if structure.offset is None or structure.basis is None:
        raise ValueError(
            "`coefficients` needs a structure whose matrices are affine in the "
            f"parameters: a template without E. Got {structure}. {_GRID}"
        )
    if T is None:
        raise ValueError(
            "`coefficients` needs a state basis that is the same everywhere. Got one "
            "that follows the scheduling variables: take those of the model before "
            f"change_basis(T). {_GRID}"
        )
    form = getattr(interpolator, "best_estimator_", interpolator)
    if not isinstance(form, PolynomialLPV | RationalLPV):
        raise ValueError(
            "`coefficients` needs an interpolation that has a form. Got "
            f"{interpolator}: {type(form).__name__} goes through the points piece by "
            "piece, or keeps its form to itself. Interpolate by PolynomialLPV() or "
            f"RationalLPV(). {_GRID}"
        )
    normalized = flag("normalized", normalized)
    if isinstance(form, PolynomialLPV):
        numerator = form.coefficients().reshape(len(form.powers_), -1)
        below, below_powers = np.ones(1), np.zeros_like(form.powers_[:1])
    else:
        numerator = form.numerator_
        below, below_powers = form.denominator_, form.denominator_powers_
    low, high = domains(form.scheduling_range_)
    centre, half_width = np.zeros_like(low), np.ones_like(low)
    ends = form.scheduling_range_
    if normalized:
        centre, half_width = (low + high) / 2.0, (high - low) / 2.0
        ends = np.array([-np.ones_like(low), np.ones_like(low)])
    else:
        growth = (1.0 + np.abs(low + high) / (high - low)) ** form.powers_
        lost = float(np.finfo(float).eps * growth.prod(axis=1).max())
        if lost > _LOST:
            warn(
                "The scheduling variables are far from zero in units of their range: "
                f"coefficients of their powers cancel, to {lost:.1g} of the matrices. "
                "Take those of variables in [-1, 1]: coefficients(normalized=True)."
            )
    numerator = conversion_to("power", form.powers_, ends) @ numerator
    below = conversion_to("power", below_powers, ends) @ below

    # one list of terms for both, by increasing degree, the constant first
    every = np.unique(np.vstack([form.powers_, below_powers]), axis=0)
    every = every[np.lexsort((*-every.T[::-1], every.sum(axis=1)))]

    def placed(values: Array, powers: Powers) -> Array:
        same = (every[:, None] == powers).all(axis=2)
        return np.asarray(same.astype(float) @ values)

    denominator = placed(below, below_powers)
    S = np.tensordot(placed(numerator, form.powers_), structure.basis, 1)
    S = S + denominator[:, None, None] * structure.offset
    A, B, C, D = blocks(S, structure.order)
    return MatrixCoefficients(
        T @ A @ np.linalg.inv(T),
        T @ B,
        C @ np.linalg.inv(T),
        D,
        every,
        denominator,
        centre,
        half_width,
        names,
        input_delay,
    )
