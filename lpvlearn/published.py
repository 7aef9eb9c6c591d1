"""The figures that the paper published, Tables 1 to 4."""

from __future__ import annotations

# Rows are theta_2 = i pi / 8, i = 1, ..., 7.
TABLE_1: dict[tuple[str, str], tuple[float, ...]] = {
    ("BFT", "y1"): (85.83, 91.23, 90.23, 92.09, 89.65, 88.42, 91.01),
    ("BFT", "y2"): (67.42, 98.18, 85.07, 97.83, 88.97, 89.82, 97.23),
    ("VAF", "y1"): (97.98, 99.23, 99.04, 99.37, 98.93, 98.66, 99.2),
    ("VAF", "y2"): (89.39, 99.96, 97.77, 99.9, 98.78, 98.96, 99.9),
}

TABLE_2 = (4.03e-3, 2.1e-3, 1.48e-3, 1.25e-3, 1.03e-3, 7.28e-4, 4.79e-4)

NOT_DETERMINED = float("nan")

# (model, degree) -> FIT of A, B, C, D
TABLE_3: dict[tuple[str, int], tuple[float, float, float, float]] = {
    ("restructured", 1): (84.7, 78.1, 97.9, NOT_DETERMINED),
    ("restructured", 2): (96.6, 88.8, 98.9, NOT_DETERMINED),
    ("analytic", 1): (88.2, 82.7, 100.0, NOT_DETERMINED),
    ("analytic", 2): (94.5, 91.5, 100.0, NOT_DETERMINED),
    ("balanced", 1): (92.0, 86.6, 84.7, 94.8),
    ("balanced", 2): (94.8, 90.1, 91.1, 98.4),
}

# (model, output) -> BFT, VAF
TABLE_4: dict[tuple[str, str], tuple[float, float]] = {
    ("restructured", "y1"): (76.2, 94.4),
    ("restructured", "y2"): (83.0, 97.1),
    ("analytic", "y1"): (78.6, 95.5),
    ("analytic", "y2"): (88.4, 98.7),
    ("balanced", "y1"): (52.7, 77.7),
    ("balanced", "y2"): (79.7, 95.9),
}
