"""Exact problems of eighteen generators: structures, and parameters that are the truth.

Chains, ladders, drivetrains, thermal and compartment networks, vehicles, aircraft,
cascades, converters, and functions of physical parameters. Parameters are positive and
spread over a decade or so; the black box is the balanced model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lpvlearn import GrayBoxStructure

Rng = np.random.Generator
template, mechanical = GrayBoxStructure.from_template, GrayBoxStructure.mechanical


class Exact(NamedTuple):
    """A structure and the parameters of its black box."""

    structure: GrayBoxStructure
    truth: np.ndarray


def _drawn(structure: GrayBoxStructure, rng: Rng, spread: float = 0.6) -> Exact:
    return Exact(structure, np.exp(spread * rng.normal(size=structure.n_params)))


def _sized(structure: GrayBoxStructure, rng: Rng, **sizes: float) -> Exact:
    """Parameters about a size each, by the first letters of their names."""
    typical = [sizes[name.rstrip("0123456789_")] for name in structure.parameter_names]
    return Exact(
        structure, np.array(typical) * np.exp(0.5 * rng.normal(size=len(typical)))
    )


def _sum(terms: list[str]) -> str:
    return " + ".join(terms) if terms else "0"


def _network(n: int, edges: list[tuple[int, int]], name: str) -> list[list[str]]:
    """Laplacian of a network with an element on every edge; -1 is the ground."""
    L = [["0"] * n for _ in range(n)]
    for i in range(n):
        own = [f"{name}{e + 1}" for e, edge in enumerate(edges) if i in edge]
        L[i][i] = _sum(own)
    for e, (i, j) in enumerate(edges):
        if i >= 0 and j >= 0:
            L[i][j] = L[j][i] = f"-{name}{e + 1}"
    return L


def _random_tree(n: int, rng: Rng) -> list[tuple[int, int]]:
    return [(int(rng.integers(0, j)), j) for j in range(1, n)] + [(-1, 0)]


def spring_chain(rng: Rng) -> Exact:
    n = int(rng.integers(2, 4))
    edges = [(i - 1, i) for i in range(n)]
    M = [[f"m{i + 1}" if i == j else "0" for j in range(n)] for i in range(n)]
    D, K = _network(n, edges, "c"), _network(n, edges, "k")
    F = np.eye(n)[:, -1:].tolist()
    return _sized(mechanical(M, D, K, F), rng, m=1.0, c=0.5, k=40.0)


def known_masses(rng: Rng) -> Exact:
    n = int(rng.integers(3, 5))
    edges = [(i - 1, i) for i in range(n)] + [(-1, n - 1)]
    D, K = _network(n, edges, "c"), _network(n, edges, "k")
    masses = np.diag(np.exp(0.3 * rng.normal(size=n))).tolist()
    F, sensors = np.eye(n)[:, :1].tolist(), np.eye(n)[[0, n - 1]]
    structure = mechanical(masses, D, K, F, sensors=sensors)
    return _sized(structure, rng, c=0.5, k=40.0)


def drivetrain(rng: Rng) -> Exact:
    """Motor, gearbox and load on shafts, torque to speeds; the load has friction."""
    J = [["j1", 0, 0], [0, "j2", 0], [0, 0, "j3"]]
    D = [["d1 + b", "-d1", 0], ["-d1", "d1 + d2", "-d2"], [0, "-d2", "d2 + f"]]
    K = [["k1", "-k1", 0], ["-k1", "k1 + k2", "-k2"], [0, "-k2", "k2 + k0"]]
    structure = mechanical(J, D, K, [[1], [0], [0]], "velocity", sensors=np.eye(3))
    sizes = {"j": 0.5, "d": 0.3, "b": 0.2, "f": 0.4, "k": 60.0}
    return _sized(structure, rng, **sizes)


def rc_ladder(rng: Rng) -> Exact:
    """Conductances g and reciprocal capacities: known ones, so it is affine."""
    n = int(rng.integers(3, 6))
    L = _network(n, [(i - 1, i) for i in range(n)], "g")
    A = [[f"-({entry})" for entry in row] for row in L]
    structure = template(A, [["g1"], *[[0]] * (n - 1)], np.eye(n)[[0, n - 1]].tolist())
    return _drawn(structure, rng)


def rlc_ladder(rng: Rng) -> Exact:
    """Currents and voltages of two sections; states scaled by 1 / L and 1 / C."""
    A = [["-r1", "-l1", 0, 0], ["c1", 0, "-c1", 0], [0, "l2", "-r2", "-l2"],
         [0, 0, "c2", "-g"]]  # fmt: skip
    structure = template(A, [["l1"], [0], [0], [0]], [[0, 1, 0, 0], [0, 0, 0, 1]])
    return _sized(structure, rng, r=1.0, l=3.0, c=3.0, g=0.5)


def thermal_network(rng: Rng) -> Exact:
    """Known capacities, positive conductances, heat in at two nodes."""
    n = int(rng.integers(4, 7))
    L = _network(n, [*_random_tree(n, rng), (-1, n - 1)], "g")
    capacity = np.exp(0.5 * rng.normal(size=n))
    A = [
        [_scaled(entry, -1.0 / capacity[i]) for entry in row] for i, row in enumerate(L)
    ]
    B = np.diag(1.0 / capacity)[:, [0, n - 1]].tolist()
    structure = template(A, B, np.eye(n)[[0, n - 1]].tolist())
    bounds = {name: (0, None) for name in structure.parameter_names}
    return _drawn(structure.with_bounds(bounds), rng)


def _scaled(entry: str, factor: float) -> str:
    return f"{float(factor)!r} * ({entry})"


def thermal_capacities(rng: Rng) -> Exact:
    """Capacities are unknown, too: E x' = A x + B u."""
    n = int(rng.integers(3, 5))
    L = _network(n, [*_random_tree(n, rng), (-1, n - 1)], "g")
    E = [[f"c{i + 1}" if i == j else 0 for j in range(n)] for i in range(n)]
    A = [[f"-({entry})" for entry in row] for row in L]
    structure = template(A, np.eye(n)[:, :1].tolist(), np.eye(n).tolist(), E=E)
    return _sized(structure, rng, c=1.0, g=1.0)


def compartments(rng: Rng) -> Exact:
    """Mammillary: all exchange with the first one, from which matter leaves."""
    n = int(rng.integers(2, 4))
    A = [["0"] * n for _ in range(n)]
    A[0][0] = "-(e" + "".join(f" + p{i}" for i in range(2, n + 1)) + ")"
    for i in range(1, n):
        A[0][i], A[i][0], A[i][i] = f"q{i + 1}", f"p{i + 1}", f"-q{i + 1}"
    B, C = np.eye(n)[:, :1].tolist(), [["v"] + [0] * (n - 1)]
    structure = template(A, B, C)
    bounds = {name: (0, None) for name in structure.parameter_names}
    return _drawn(structure.with_bounds(bounds), rng)


def chain_compartments(rng: Rng) -> Exact:
    n = int(rng.integers(3, 5))
    A = [["0"] * n for _ in range(n)]
    for i in range(n):
        leaving = [f"f{i + 1}"] if i < n - 1 else ["e"]
        if i:
            leaving.append(f"b{i}")
            A[i][i - 1], A[i - 1][i] = f"f{i}", f"b{i}"
        A[i][i] = f"-({_sum(leaving)})"
    C = np.eye(n)[[0, n - 1]].tolist()
    return _drawn(template(A, np.eye(n)[:, :1].tolist(), C), rng)


def quarter_car(rng: Rng) -> Exact:
    M, D = [["ms", 0], [0, "mu"]], [["cs", "-cs"], ["-cs", "cs"]]
    K = [["ks", "-ks"], ["-ks", "ks + kt"]]
    structure = mechanical(M, D, K, [[1, 0], [0, 1]])
    return _sized(structure, rng, ms=3.0, mu=0.4, cs=3.0, ks=30.0, kt=200.0)


def bicycle(rng: Rng) -> Exact:
    """Lateral speed and yaw rate of a car: stability derivatives, steering in."""
    structure = template(
        [["-yv", "yr - 20"], ["nv", "-nr"]], [["yd"], ["nd"]], [[1, 0], [0, 1]]
    )
    return _sized(structure, rng, yv=5.0, yr=0.5, nv=1.0, nr=6.0, yd=40.0, nd=30.0)


def short_period(rng: Rng) -> Exact:
    """Angle of attack and pitch rate, with an elevator actuator."""
    A = [["-za", 1, "-zd"], ["-ma", "-mq", "-md"], [0, 0, "-w"]]
    structure = template(A, [[0], [0], ["w"]], [[1, 0, 0], [0, 1, 0]])
    return _sized(structure, rng, za=1.0, zd=0.1, ma=6.0, mq=1.5, md=10.0, w=20.0)


def cascade(rng: Rng) -> Exact:
    """Lags in series behind one gain."""
    n = int(rng.integers(2, 5))
    A = [["0"] * n for _ in range(n)]
    for i in range(n):
        A[i][i] = f"-a{i + 1}"
        if i:
            A[i][i - 1] = f"a{i + 1}"
    structure = template(A, [["g"], *[[0]] * (n - 1)], [[0] * (n - 1) + [1]])
    return _drawn(structure, rng, 0.8)


def tanks(rng: Rng) -> Exact:
    """Four tanks with two pumps whose flows divide."""
    A = [["-a", 0, "c", 0], [0, "-b", 0, "d"], [0, 0, "-c", 0], [0, 0, 0, "-d"]]
    B = [["p", 0], [0, "q"], [0, "r"], ["s", 0]]
    return _drawn(template(A, B, [[1, 0, 0, 0], [0, 1, 0, 0]]), rng)


def converter(rng: Rng) -> Exact:
    """Buck converter with an input filter: inductances and capacities inverted."""
    A = [["-r1", "-l1", 0, 0], ["k1", 0, "-0.4*k1", 0], [0, "0.4*l2", "-r2", "-l2"],
         [0, 0, "k2", "-g"]]  # fmt: skip
    structure = template(A, [["l1"], [0], [0], [0]], [[1, 0, 0, 0], [0, 0, 0, 1]])
    return _sized(structure, rng, r=0.5, l=4.0, k=4.0, g=0.8)


def modal_form(rng: Rng) -> Exact:
    n = int(rng.integers(2, 4))
    structure = GrayBoxStructure.modal(n, 1, 2)
    rates = np.exp(np.cumsum(rng.uniform(0.4, 0.9, n)))
    sizes = {"c": 1.0, "d": 0.3, "w": 1.0}
    found = []
    for name in structure.parameter_names:
        i = int(name.split("_")[-1]) - 1
        size = sizes[name[0]] * (rates[i] ** 2 if name[0] == "w" else 1.0)
        found.append(size if name[0] == "w" else size * np.exp(0.4 * rng.normal()))
    return Exact(structure, np.array(found))


def _pendulum(theta: np.ndarray) -> tuple:
    mass, bob, length, k, c, friction = theta
    M = np.array([[mass + bob, bob * length], [bob * length, bob * length**2]])
    K = np.array([[k, 0 * k], [0 * k, bob * 9.81 * length]])
    D = np.array([[c, 0 * c], [0 * c, friction]])
    inverse = np.array([[M[1, 1], -M[0, 1]], [-M[1, 0], M[0, 0]]])
    inverse = inverse / (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ D]])
    return A, np.concatenate([np.zeros(2), inverse[:, 0]])[:, None], np.eye(4)[:2]


def cart_pendulum(rng: Rng) -> Exact:
    guess = np.array([1.0, 0.3, 0.5, 8.0, 0.4, 0.01])
    names = ["mass", "bob", "length", "k", "c", "friction"]
    structure = GrayBoxStructure.from_function(_pendulum, guess, parameter_names=names)
    return Exact(structure, guess * np.exp(0.4 * rng.normal(size=6)))


def _motor(theta: np.ndarray) -> tuple:
    resistance, inductance, constant, inertia, friction = theta
    A = [[-resistance / inductance, -constant / inductance],
         [constant / inertia, -friction / inertia]]  # fmt: skip
    return A, [[1 / inductance], [0 * inductance]], [[1, 0], [0, 1]]


def motor(rng: Rng) -> Exact:
    guess = np.array([1.0, 0.01, 0.1, 1e-3, 1e-3])
    structure = GrayBoxStructure.from_function(_motor, guess)
    return Exact(structure, guess * np.exp(0.5 * rng.normal(size=5)))


GENERATORS: dict[str, Callable[[Rng], Exact]] = {
    f.__name__: f
    for f in (
        spring_chain,
        known_masses,
        drivetrain,
        rc_ladder,
        rlc_ladder,
        thermal_network,
        thermal_capacities,
        compartments,
        chain_compartments,
        quarter_car,
        bicycle,
        short_period,
        cascade,
        tanks,
        converter,
        modal_form,
        cart_pendulum,
        motor,
    )  # fmt: skip
}


def problems(count: int, first: int = 0):
    """(generator, seed, structure, truth) of stable, not too stiff black boxes."""
    for seed in range(first, first + count):
        name = list(GENERATORS)[seed % len(GENERATORS)]
        rng = np.random.default_rng([seed, 13])
        while True:
            found = GENERATORS[name](rng)
            poles = found.structure.model(found.truth).poles()
            decay, size = -poles.real, np.abs(poles)
            if decay.min() > 1e-3 * size.max():
                yield name, seed, *found
                break
