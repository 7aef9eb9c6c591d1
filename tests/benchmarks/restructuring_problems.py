"""Problems of the restructuring studies: models with noise, or off the structure."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpvlearn import GrayBoxStructure, LocalLPVPipeline, StateSpace, SubspaceLTI
from lpvlearn.datasets import make_flexible_arm

Structure = GrayBoxStructure
RANGE = 5.0  # known ranges reach from truth / RANGE to truth * RANGE


@dataclass
class Problem:
    """A black box, a structure, and the parameters it was made from."""

    name: str
    seed: str
    structure: GrayBoxStructure
    model: StateSpace
    truth: np.ndarray


# -- noisy black boxes -------------------------------------------------------------


def arm_problems(seed: int, cache: Path | None) -> Iterator[Problem]:
    """Seven averaged local models of the arm, identified from 30 noisy experiments."""
    file = cache / f"arm{seed}.pkl" if cache is not None else None
    structure = make_flexible_arm(2, duration=0.2, random_state=0).structure
    if file is None or not file.exists():
        data = make_flexible_arm(n_realizations=30, random_state=seed)
        pipeline = LocalLPVPipeline(
            local=SubspaceLTI(order=6, feedthrough=False),
            restructurer="passthrough",
            scheduling="kappa",
            experiment="experiment",
            time="time",
            combine="average",
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pipeline.fit(data.X, data.y)
        theta2 = np.arccos(np.clip(pipeline.operating_points_[:, 0], -1, 1))
        found = [
            ((m.A, m.B, m.C, m.D, m.sampling_time), data.arm.parameters(angle))
            for m, angle in zip(pipeline.local_models_, theta2, strict=True)
        ]
        if file is not None:
            file.write_bytes(pickle.dumps(found))
    else:
        found = pickle.loads(file.read_bytes())
    for point, (matrices, truth) in enumerate(found):
        label = f"{seed}/{point}"
        yield Problem("arm", label, structure, StateSpace(*matrices), truth)


def cart(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cart on a spring with a hanging pendulum: mass, bob, length, k, c, friction."""
    mass, bob, length, k, c, friction = theta
    M = np.array([[mass + bob, bob * length], [bob * length, bob * length**2]])
    K = np.array([[k, 0 * k], [0 * k, bob * 9.81 * length]])
    D = np.array([[c, 0 * c], [0 * c, friction]])
    inverse = np.array([[M[1, 1], -M[0, 1]], [-M[1, 0], M[0, 0]]])
    inverse = inverse / (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ D]])
    B = np.concatenate([np.zeros(2), inverse[:, 0]])[:, None]
    return A, B, np.eye(4)[:2]


CART = {"mass": 1.0, "bob": 0.3, "length": 0.5, "k": 8.0, "c": 0.4, "friction": 0.01}


def chain(n: int, masses: bool, sensors: list[int], forces: list[int]) -> Structure:
    """Masses on a line, tied to each other and the first one to the ground."""
    K = [["0"] * n for _ in range(n)]
    for i in range(n):
        K[i][i] = f"k{i + 1} + k{i + 2}" if i + 1 < n else f"k{i + 1}"
        if i:
            K[i][i - 1] = K[i - 1][i] = f"-k{i + 1}"
    D = [[entry.replace("k", "c") for entry in row] for row in K]
    M = [[0] * n for _ in range(n)]
    for i in range(n):
        M[i][i] = f"m{i + 1}" if masses else 1
    F = [[float(i == j) for j in forces] for i in range(n)]
    return Structure.mechanical(M, D, K, F, sensors=np.eye(n)[sensors])


def ranged(structure: Structure, truth: dict[str, float]) -> Structure:
    """Known ranges around the truth, and the signs as bounds."""
    limits = {name: (v / RANGE, v * RANGE) for name, v in truth.items()}
    positive = {name: (0, None) for name in truth}
    return structure.with_bounds(positive).with_ranges(limits)


def spring() -> tuple[Structure, dict[str, float], float]:
    structure = Structure.from_template([[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]])
    return structure, {"b": 2.0, "c": 0.5, "k": 4.0}, 0.1


def two_masses() -> tuple[Structure, dict[str, float], float]:
    truth = {"k1": 20.0, "k2": 10.0, "c1": 0.4, "c2": 0.2}
    return chain(2, False, [0, 1], [0]), truth, 0.05


def heat_exchanger() -> tuple[Structure, dict[str, float], float]:
    A = [["-f1 - h1", "h1", 0], ["g1", "-g1 - g2", "g2"], [0, "h2", "-f2 - h2"]]
    structure = Structure.from_template(A, [["f1"], [0], [0]], np.eye(3).tolist())
    truth = {"f1": 0.2, "h1": 0.1, "g1": 0.05, "g2": 0.04, "h2": 0.08, "f2": 0.12}
    return structure, truth, 1.0


def dc_motor() -> tuple[Structure, dict[str, float], float]:
    A = [
        ["-r", "-e", 0, 0],
        ["t", "-b1", "-k1", 0],
        [0, 1, 0, -1],
        [0, 0, "k2", "-b2"],
    ]
    C = [[1, 0, 0, 0], [0, 1, 0, 0]]
    structure = Structure.from_template(A, [["g"], [0], [0], [0]], C)
    truth = {"r": 250.0, "e": 20.0, "t": 400.0, "b1": 2.0}
    truth |= {"k1": 900.0, "k2": 300.0, "b2": 0.5, "g": 100.0}
    return structure, truth, 2e-3


def quarter_car() -> tuple[Structure, dict[str, float], float]:
    structure = Structure.mechanical(
        M=[["body", 0], [0, "wheel"]],
        D=[["c", "-c"], ["-c", "c"]],
        K=[["k", "-k"], ["-k", "k + tyre"]],
        F=[[1, 0], [-1, "tyre"]],
    )
    truth = {"body": 0.3, "wheel": 0.04, "c": 1.0, "k": 16.0, "tyre": 190.0}
    return ranged(structure, truth), truth, 5e-3


def six_masses() -> tuple[Structure, dict[str, float], float]:
    truth = {f"k{i + 1}": 60.0 + 15 * i for i in range(6)}
    truth |= {f"c{i + 1}": 0.5 + 0.1 * i for i in range(6)}
    structure = chain(6, False, [0, 2, 5], [0])
    return structure.with_bounds(dict.fromkeys(truth, (0, None))), truth, 0.05


def tanks() -> tuple[Structure, dict[str, float], float]:
    A = [["-a1", 0, 0], ["a1", "-a2", 0], [0, "a2", "-a3"]]
    structure = Structure.from_template(A, [["b"], [0], [0]], [[1, 0, 0], [0, 0, 1]])
    return structure, {"a1": 0.02, "a2": 0.05, "a3": 0.03, "b": 0.01}, 5.0


def cart_pendulum() -> tuple[Structure, dict[str, float], float]:
    structure = Structure.from_function(cart, CART)
    return ranged(structure, CART), CART, 0.05


def masses_unknown() -> tuple[Structure, dict[str, float], float]:
    truth = {"k1": 20.0, "k2": 10.0, "c1": 0.4, "c2": 0.2, "m1": 2.0, "m2": 0.5}
    return ranged(chain(2, True, [0, 1], [0]), truth), truth, 0.05


NOISY: dict[str, Callable[[], tuple[Structure, dict[str, float], float]]] = {
    "spring": spring,
    "two masses": two_masses,
    "heat exchanger": heat_exchanger,
    "dc motor": dc_motor,
    "quarter car": quarter_car,
    "six masses": six_masses,
    "tanks": tanks,
    "cart": cart_pendulum,
    "masses unknown": masses_unknown,
}


def noisy_problem(name: str, seed: int, snr_db: float = 30.0) -> Problem:
    """A model identified from 4000 noisy samples of a random physical system."""
    structure, values, step = NOISY[name]()
    rng = np.random.default_rng(seed)
    nominal = np.array([values[key] for key in structure.parameter_names])
    truth = nominal * np.exp(0.2 * rng.normal(size=len(nominal)))
    model = structure.model(truth)
    u = np.sign(rng.normal(size=(4000, model.n_inputs)))
    u = np.repeat(u[:1000], 4, axis=0)  # a random binary signal
    y = model.simulate(u, sampling_time=step)
    y += 10 ** (-snr_db / 20) * y.std(0) * rng.normal(size=y.shape)
    local = SubspaceLTI(model.order, feedthrough=False, sampling_time=step)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        black_box = local.fit(u, y).lti_.to_continuous("zoh")
    D = np.zeros_like(black_box.D)
    black_box = StateSpace(black_box.A, black_box.B, black_box.C, D)
    return Problem(name, str(seed), structure, black_box, truth)


# -- black boxes off the structure ---------------------------------------------------


def arm_structure() -> Structure:
    """The arm's structure with links of 1 m and 0.8 m."""
    P = [[f"p{4 * c + r + 1}" for c in range(4)] for r in range(4)]
    A = [[0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1], *(row + [0, 0] for row in P)]
    B = [[0, 0], [0, 0], *([f"-{row[2]}", f"-{row[3]}"] for row in P)]
    C = [[0, 0, 1, 0, 1.0, 0], [0, 0, 0, 1, 1.0, 0.8]]
    return Structure.from_template(A, B, C)


def random_arm(structure: Structure, rng: np.random.Generator) -> np.ndarray:
    """Parameters of a stable arm: drives, flexible modes and their coupling."""
    while True:
        k = rng.uniform(3, 12, 2)
        w = np.sort(rng.uniform(4, 25, 2))
        P = np.zeros((4, 4))
        P[0, 2], P[1, 3] = -k
        both = rng.uniform(0.1, 0.6, 2) * k * w**2
        c = np.sqrt(both) * rng.uniform(0.5, 2, 2)
        P[0, 0], P[1, 1] = c
        P[2, 2], P[3, 3] = both / c
        P[2, 0], P[3, 1] = -(w**2)
        for (i, j), size in (
            ((0, 1), 0.3 * c[0]),
            ((1, 0), 0.3 * c[1]),
            ((0, 3), 0.2 * k[0]),
            ((1, 2), 0.2 * k[1]),
            ((2, 1), 0.2 * w[0] ** 2),
            ((3, 0), 0.2 * w[1] ** 2),
            ((2, 3), 0.3 * P[2, 2]),
            ((3, 2), 0.3 * P[3, 3]),
        ):
            P[i, j] = size * rng.standard_normal()
        theta = P.T.ravel()
        poles = structure.model(theta).poles()
        if -3 < poles.real.max() < -0.1 and np.abs(poles).max() < 80:
            return theta


def family_problem(seed: int, perturbation: float) -> Problem:
    """An arm with all entries perturbed; its static gain stays the identity."""
    structure, rng = arm_structure(), np.random.default_rng(seed)
    truth = random_arm(structure, rng)
    A, B, C, _ = structure.matrices(truth)
    size = np.abs(A).max(1, keepdims=True)
    while True:
        normal = rng.standard_normal
        A0 = A * (1 + perturbation * normal(A.shape))
        A0 = A0 + 0.02 * perturbation * size * normal(A.shape)
        B0 = B * (1 + perturbation * normal(B.shape))
        C0 = C * (1 + perturbation * normal(C.shape))
        spread = np.array([0, 0, 1, 1, 0.05, 0.05])
        C0 = C0 + 0.1 * perturbation * normal(C.shape) * spread
        if np.linalg.eigvals(A0).real.max() < -0.05:
            gain = -C0 @ np.linalg.solve(A0, B0)
            model = StateSpace(A0, B0, np.linalg.solve(gain, C0))
            return Problem(
                f"family {perturbation:.0%}", str(seed), structure, model, truth
            )


def random_modes(
    n: int, m: int, p: int, rng: np.random.Generator, size: float = 1.0
) -> StateSpace:
    """Stable modes over 1.5 decades, of any damping."""
    A = np.zeros((n, n))
    for i in range(0, n - 1, 2):
        w, z = 10 ** rng.uniform(-0.75, 0.75), 10 ** rng.uniform(-1.7, -0.2)
        A[i : i + 2, i : i + 2] = w * np.array(
            [[-z, np.sqrt(1 - z * z)], [-np.sqrt(1 - z * z), -z]]
        )
    if n % 2:
        A[-1, -1] = -(10 ** rng.uniform(-0.75, 0.75))
    decay = np.sqrt(size * np.abs(np.diag(A)))[:, None]
    return StateSpace(
        A, decay * rng.normal(size=(n, m)), (decay * rng.normal(size=(n, p))).T
    )


def beside(one: StateSpace, two: StateSpace) -> StateSpace:
    """The sum of two models."""
    zero = np.zeros((one.order, two.order))
    A = np.block([[one.A, zero], [zero.T, two.A]])
    return StateSpace(A, np.vstack([one.B, two.B]), np.hstack([one.C, two.C]))


def perturbed(model: StateSpace, rng: np.random.Generator, size: float) -> StateSpace:
    """A stable model with all entries perturbed."""
    scale = np.abs(model.A).max(1, keepdims=True)
    while True:
        A, B, C = (
            M * (1 + size * rng.normal(size=M.shape))
            for M in (model.A, model.B, model.C)
        )
        A = A + 0.1 * size * scale * rng.normal(size=A.shape)
        if np.linalg.eigvals(A).real.max() < 0:
            return StateSpace(A, B, C)


ORDERS = (4, 6, 8, 12)


def random_problem(kind: str, seed: int) -> Problem:
    """A random structure of 4 to 12 states, and a black box that it cannot reach."""
    rng = np.random.default_rng([seed, len(kind)])
    n = ORDERS[seed % len(ORDERS)]
    m, p = 1 + seed // 4 % 2, 1 + seed // 2 % 2
    label = f"{seed} n={n} {p}x{m}"
    if kind in ("companion", "modal"):
        black_box = beside(
            random_modes(n, m, p, rng), random_modes(n // 2, m, p, rng, 0.1)
        )
        black_box = black_box.transform(rng.normal(size=(black_box.order,) * 2))
        structure = (
            Structure.observable_canonical(n, m, p)
            if kind == "companion"
            else Structure.modal(n // 2, m, p)
        )
        return Problem(kind, label, structure, black_box, np.zeros(0))
    if kind == "cart":
        structure, values = cart_pendulum()[0], CART
    else:
        masses, count = kind == "masses", n // 2
        names = [(f"k{i + 1}", 10.0) for i in range(count)]
        names += [(f"c{i + 1}", 0.2) for i in range(count)]
        names += [(f"m{i + 1}", 1.0) for i in range(count if masses else 0)]
        values = dict(names)
        sensors = sorted(rng.choice(count, min(1 + p, count), replace=False).tolist())
        structure = chain(count, masses, sensors, [0])
        structure = ranged(structure, values) if masses else structure
    nominal = np.array([values[name] for name in structure.parameter_names])
    truth = nominal * np.exp(0.4 * rng.normal(size=len(nominal)))
    black_box = perturbed(structure.model(truth), rng, 0.03)
    return Problem(kind, label, structure, black_box, truth)


RANDOM = ("companion", "modal", "mechanical", "masses", "cart")
