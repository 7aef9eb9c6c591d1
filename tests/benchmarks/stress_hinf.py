"""Stress of the H-infinity kernel on adversarial random systems.

Every system is compared with a dense grid in units of each pole's distance from
the boundary, refined around every local maximum, with the values at the maxima
in extended precision. Run as a script::

    python tests/benchmarks/stress_hinf.py --systems 6000 --seed 0
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import cont2discrete

from lpvlearn.systems.hinf_norm import linf_norm

WITHIN = 0.6
TOLERANCE = 1e-8
Matrices = tuple[NDArray, NDArray, NDArray, NDArray]


@dataclass(frozen=True)
class Case:
    """One system of the stress and the family it was drawn from."""

    family: str
    system: Matrices
    dt: float | None = None


# ---------------------------------------------------------------- families


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(low, high))


def orthogonal(rng: np.random.Generator, n: int) -> NDArray:
    return np.linalg.qr(rng.standard_normal((n, n)))[0]


def mixed(rng: np.random.Generator, system: Matrices, spread: float = 1.0) -> Matrices:
    """Change of state coordinates with singular values over `spread` decades."""
    A, B, C, D = system
    n = len(A)
    if n == 0:
        return system
    left, right = orthogonal(rng, n), orthogonal(rng, n)
    s = 10.0 ** rng.uniform(-spread / 2, spread / 2, n)
    T, T_inv = (left * s) @ right, right.T @ (left / s).T
    return T_inv @ A @ T, T_inv @ B, C @ T, D


def resonator(w: float, z: float, gain: float) -> Matrices:
    """gain * 2 z w**2 / (s**2 + 2 z w s + w**2): close to gain at w."""
    A = np.array([[0.0, w], [-w, -2.0 * z * w]])
    B, C = np.array([[0.0], [w]]), np.array([[2.0 * z * gain, 0.0]])
    return A, B, C, np.zeros((1, 1))


def peak_of_lag(z: float) -> float:
    return 1.0 if z >= np.sqrt(0.5) else 1.0 / (2.0 * z * np.sqrt(1.0 - z * z))


def diagonal(parts: list[Matrices]) -> Matrices:
    return tuple(block_diag(*matrices) for matrices in zip(*parts, strict=True))


def channels_mixed(rng: np.random.Generator, system: Matrices) -> Matrices:
    A, B, C, D = system
    U, V = orthogonal(rng, D.shape[0]), orthogonal(rng, D.shape[1])
    return A, B @ V, U @ C, U @ D @ V


def modal(
    rng: np.random.Generator, order: int, damping: float = -7.0, span: float = 2.0
) -> Matrices:
    """Random modes with damping 10**damping to 1 over `span` decades."""
    blocks = []
    left = order
    while left:
        w = log_uniform(rng, -span / 2, span / 2)
        if left >= 2 and rng.random() < 0.8:
            z = log_uniform(rng, damping, -0.05)
            blocks.append(
                w * np.array([[-z, np.sqrt(1 - z * z)], [-np.sqrt(1 - z * z), -z]])
            )
            left -= 2
        else:
            blocks.append(np.array([[-w]]))
            left -= 1
    A = block_diag(*blocks)
    n_inputs, n_outputs = rng.integers(1, 5, 2)
    size = 10.0 ** rng.uniform(-1, 1, order)
    B = rng.standard_normal((order, n_inputs)) * size[:, None]
    C = rng.standard_normal((n_outputs, order))
    D = rng.standard_normal((n_outputs, n_inputs)) * rng.choice([0.0, 0.1, 3.0])
    return A, B, C, D


def random_order(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 17))


def damped(rng: np.random.Generator) -> Matrices:
    return mixed(rng, modal(rng, random_order(rng)))


def time_scaled(rng: np.random.Generator) -> Matrices:
    A, B, C, D = mixed(rng, modal(rng, random_order(rng), -5.0))
    scale = log_uniform(rng, -8, 8)
    return A * scale, B * scale, C, D


def stiff(rng: np.random.Generator) -> Matrices:
    return modal(rng, random_order(rng), -4.0, span=8.0)


def channel_scaled(rng: np.random.Generator) -> Matrices:
    A, B, C, D = mixed(rng, modal(rng, random_order(rng), -4.0))
    rows = 10.0 ** rng.uniform(-6, 6, D.shape[0])[:, None]
    columns = 10.0 ** rng.uniform(-6, 6, D.shape[1])
    states = 2.0 ** rng.integers(-20, 20, len(A))
    A, B, C = A / states[:, None] * states, B / states[:, None], C * states
    return A, B * columns, rows * C, rows * D * columns


def feedthrough_channel(rng: np.random.Generator) -> Matrices:
    """A channel with feedthrough just under (or over) the peak of another."""
    z = log_uniform(rng, -5, -0.3)
    lag = resonator(log_uniform(rng, -1, 1), z, 1.0)
    gap = rng.choice([-1.0, 1.0]) * log_uniform(rng, -9, -1)
    d = 2.0 * z * peak_of_lag(z) * (1.0 - gap)
    static = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[d]])
    return mixed(rng, channels_mixed(rng, diagonal([lag, static])))


def feedthrough_bump(rng: np.random.Generator) -> Matrices:
    """D (1 + bump): the peak stands only 1e-7 to 1 above G(0) and G(inf)."""
    w, z = log_uniform(rng, -1, 1), log_uniform(rng, -5, 0)
    A, B, C, _ = resonator(w, z, 1.0)
    height = log_uniform(rng, -7, 0) * rng.choice([-1.0, 1.0])
    C = np.array([[0.0, 2.0 * z * height]])
    D = np.array([[1.0]]) * log_uniform(rng, -3, 3)
    return mixed(rng, (A, B, C * D, D))


def equal_peaks(rng: np.random.Generator) -> Matrices:
    parts = []
    for _ in range(int(rng.integers(2, 5))):
        z = log_uniform(rng, -7, -0.5)
        gain = 1.0 / (2.0 * z * peak_of_lag(z))
        parts.append(resonator(log_uniform(rng, -2, 2), z, gain))
    return mixed(rng, channels_mixed(rng, diagonal(parts)))


def close_peaks(rng: np.random.Generator) -> Matrices:
    """Two resonances 1e-5 apart, as channels or as a sum."""
    w, z = log_uniform(rng, -1, 1), log_uniform(rng, -7, -5.7)
    twin = w * (1.0 + 1e-5 * rng.uniform(1, 3))
    parts = [resonator(w, z, 1.0), resonator(twin, z, rng.uniform(0.6, 1.0))]
    A, B, C, D = diagonal(parts)
    if rng.random() < 0.5:
        one = np.ones((2, 1))
        return mixed(rng, (A, B @ one, one.T @ C, np.zeros((1, 1))))
    return mixed(rng, channels_mixed(rng, (A, B, C, D)))


def near_axis(rng: np.random.Generator) -> Matrices:
    A, B, C, D = modal(rng, random_order(rng), -7.0)
    slow = np.diag(-(10.0 ** rng.uniform(-7, -3, 2)))
    n_outputs, n_inputs = D.shape
    return (
        block_diag(A, slow),
        np.vstack((B, rng.standard_normal((2, n_inputs)) * 1e-4)),
        np.hstack((C, rng.standard_normal((n_outputs, 2)))),
        D,
    )


def non_minimal(rng: np.random.Generator) -> Matrices:
    A, B, C, D = modal(rng, random_order(rng), -5.0)
    hidden, Bh, Ch, _ = modal(rng, int(rng.integers(1, 7)), -7.0)
    n_hidden = len(hidden)
    if rng.random() < 0.5:
        Bh, Ch = np.zeros((n_hidden, B.shape[1])), np.tile(Ch[:1], (len(C), 1))
    else:
        Bh, Ch = np.tile(Bh[:, :1], (1, B.shape[1])), np.zeros((len(C), n_hidden))
    system = block_diag(A, hidden), np.vstack((B, Bh)), np.hstack((C, Ch)), D
    return mixed(rng, system)


def error_system(rng: np.random.Generator) -> Matrices:
    """G(theta) - G0 with parameters 1e-6 to 0.1 apart."""
    A, B, C, D = modal(rng, random_order(rng), -3.0)
    change = log_uniform(rng, -6, -1)

    def moved(M: NDArray) -> NDArray:
        return M * (1.0 + change * rng.standard_normal(M.shape))

    other = moved(A) - change * np.eye(len(A)) * np.abs(A).max()
    other, other_B, other_C, _ = mixed(rng, (other, moved(B), moved(C), D))
    return (
        block_diag(A, other),
        np.vstack((B, other_B)),
        np.hstack((C, -other_C)),
        np.zeros_like(D),
    )


def unstable(rng: np.random.Generator) -> Matrices:
    A, B, C, D = modal(rng, random_order(rng), -5.0)
    signs = rng.choice([-1.0, 1.0])
    return mixed(rng, (signs * A, B, C, D))


def repeated_poles(rng: np.random.Generator) -> Matrices:
    """A chain of equal lags: eigenvectors are useless as coordinates."""
    lag = resonator(1.0, log_uniform(rng, -2, 0), 1.0)
    system = lag
    for _ in range(int(rng.integers(1, 4))):
        A, B, C, D = system
        A2, B2, C2, D2 = lag
        system = (
            np.block([[A, np.zeros((len(A), 2))], [B2 @ C, A2]]),
            np.vstack((B, B2 @ D)),
            np.hstack((D2 @ C, C2)),
            D2 @ D,
        )
    A, B, C, D = system
    D = np.array([[rng.choice([0.0, 1.0])]])
    return mixed(rng, (A, B, C, D), spread=0.5)


def dense(rng: np.random.Generator) -> Matrices:
    n = random_order(rng)
    A = rng.standard_normal((n, n))
    A -= (np.linalg.eigvals(A).real.max() + log_uniform(rng, -5, 0)) * np.eye(n)
    n_outputs, n_inputs = rng.integers(1, 5, 2)
    D = rng.standard_normal((n_outputs, n_inputs)) * rng.choice([0.0, 1.0, 30.0])
    B = rng.standard_normal((n, n_inputs))
    return A, B, rng.standard_normal((n_outputs, n)), D


CONTINUOUS: tuple[Callable[[np.random.Generator], Matrices], ...] = (
    damped,
    time_scaled,
    stiff,
    channel_scaled,
    feedthrough_channel,
    feedthrough_bump,
    equal_peaks,
    close_peaks,
    near_axis,
    non_minimal,
    error_system,
    unstable,
    repeated_poles,
    dense,
)


def discrete_disc(rng: np.random.Generator) -> Matrices:
    """Poles drawn in the disc, down to 1e-7 from the circle, also near 1 and -1."""
    A, B, C, D = modal(rng, random_order(rng), -7.0)
    blocks, i = [], 0
    while i < len(A):
        radius = 1.0 - log_uniform(rng, -7, 0)
        if i + 1 < len(A) and rng.random() < 0.7:
            angle = rng.uniform(0, np.pi)
            c, s = radius * np.cos(angle), radius * np.sin(angle)
            blocks.append(np.array([[c, s], [-s, c]]))
        else:
            blocks.append(np.array([[radius * rng.choice([-1.0, 1.0])]]))
        i += len(blocks[-1])
    return block_diag(*blocks), B, C, D


def discretised(
    rng: np.random.Generator, family: Callable[[np.random.Generator], Matrices]
) -> tuple[Matrices, float]:
    A, B, C, D = family(rng)
    p = np.linalg.eigvals(A)
    dt = log_uniform(rng, -4, 0.5) / np.abs(p).max()
    # A pole nearer than this moves visibly with the last bit of the matrices.
    dt = max(dt, min(1e-10 / np.abs(p.real).min(), 3.0 / np.abs(p).max()))
    method = rng.choice(["zoh", "bilinear"])
    sampled = cont2discrete((A, B, C, D), dt, method=method)[:4]
    return sampled, dt


DISCRETISED = (
    damped,
    time_scaled,
    feedthrough_bump,
    equal_peaks,
    non_minimal,
    error_system,
    dense,
)


def drawn(index: int, seed: int) -> Case:
    """Draw one system, the families in turn."""
    rng = np.random.default_rng([seed, index])
    k = index % (len(CONTINUOUS) + len(DISCRETISED) + 2)
    if k < len(CONTINUOUS):
        return Case(CONTINUOUS[k].__name__, CONTINUOUS[k](rng))
    if k < len(CONTINUOUS) + len(DISCRETISED):
        family = DISCRETISED[k - len(CONTINUOUS)]
        system, dt = discretised(rng, family)
        return Case(f"sampled {family.__name__}", system, dt)
    return Case("discrete_disc", discrete_disc(rng), 1.0)


def cases(count: int, seed: int) -> Iterator[Case]:
    """Draw as many systems."""
    for index in range(count):
        yield drawn(index, seed)


# --------------------------------------------------------------- reference


def largest(G: NDArray) -> NDArray:
    return np.linalg.svd(G, compute_uv=False)[:, 0]


def gain(system: Matrices, omega: NDArray, dt: float | None) -> NDArray:
    A, B, C, D = system
    x = 1j * omega if dt is None else np.exp(1j * omega)
    M = x[:, None, None] * np.eye(len(A)) - A
    return largest(C @ np.linalg.solve(M, np.broadcast_to(B, (len(x), *B.shape))) + D)


def extended_gain(system: Matrices, omega: NDArray, dt: float | None) -> NDArray:
    """The same by Gaussian elimination in extended precision."""
    A, B, C, D = (M.astype(np.longdouble) for M in system)
    n, k = len(A), len(omega)
    w = omega.astype(np.longdouble)
    x = 1j * w
    if dt is not None:  # z - 1 and A - I, both without cancellation
        x, A = -2 * np.sin(w / 2) ** 2 + 1j * np.sin(w), A - np.eye(n)
    M = np.empty((k, n, n + B.shape[1]), np.clongdouble)
    M[:, :, :n] = x[:, None, None] * np.eye(n) - A
    M[:, :, n:] = B
    rows = np.arange(k)
    for j in range(n):
        pivot = j + np.abs(M[:, j:, j]).argmax(1)
        swap = M[rows, pivot].copy()
        M[rows, pivot] = M[:, j]
        M[:, j] = swap / swap[:, j, None]
        factor = M[:, :, j].copy()
        factor[:, j] = 0
        M -= factor[:, :, None] * M[:, None, j]
    G = np.matmul(C.astype(np.clongdouble), M[:, :, n:]) + D
    # The last digits matter only in G: one eigenvalue of G^H G by power steps.
    U, _, Vh = np.linalg.svd(G.astype(complex))
    u, v = U[:, :, 0].astype(np.clongdouble), Vh[:, 0].conj().astype(np.clongdouble)
    return np.abs(np.einsum("ki,kij,kj->k", u.conj(), G, v)).astype(float)


def reference_grid(system: Matrices, dt: float | None) -> NDArray:
    p = np.linalg.eigvals(system[0])
    if dt is None:
        centre, depth = np.abs(p.imag), np.abs(p.real)
    else:
        centre, depth = np.abs(np.angle(p)), np.abs(np.abs(p) - 1.0)
    steps = np.concatenate((np.geomspace(1e-3, 1e2, 36), np.linspace(0, 3, 61)))
    steps = np.concatenate((-steps, steps))[:, None]
    near = centre + depth * steps
    # A bump on a plateau may be as narrow as it is low.
    tip = np.sqrt(np.maximum(centre**2 - depth**2, 0.0))
    tip = tip + depth * 10.0 ** np.arange(-5.0, 0.0)[:, None] * [[[-1.0]], [[1.0]]]
    size = np.hypot(centre, depth)
    low, high = 1e-3 * size.min(), 1e3 * size.max()
    wide = np.geomspace(low, high if dt is None else np.pi, 400)
    w = np.abs(np.concatenate((near.ravel(), tip.ravel(), wide, size, [0.0])))
    if dt is not None:
        rest = np.hypot(np.pi - centre, depth).min()
        w = np.concatenate((w, np.pi - np.geomspace(1e-3 * rest, np.pi, 100)))
        w = np.append(w[(w >= 0) & (w < np.pi)], np.pi)
    return np.unique(w)


def reference_peaks(system: Matrices, dt: float | None) -> tuple[NDArray, NDArray]:
    """All local maxima (angle or rad/s, infinity included) and their values."""
    w = reference_grid(system, dt)
    s = gain(system, w, dt)
    if dt is None:
        w, s = np.append(w, np.inf), np.append(s, largest(system[3][None]))
    rises = np.concatenate(([True], s[1:] >= s[:-1]))
    falls = np.concatenate((s[:-1] >= s[1:], [True]))
    top = np.flatnonzero(rises & falls & (s >= 0.3 * s.max()))
    lower = w[np.maximum(top - 1, 0)]
    upper = w[np.minimum(top + 1, len(w) - 1)]
    upper = np.where(np.isinf(upper), w[top], upper)
    centre, finite = w[top].copy(), np.isfinite(w[top])
    evaluate = careful_gain(system, dt)
    bracket = lower[finite], upper[finite]
    if evaluate is extended_gain:
        # Rounding may have put the highest sample beside the peak.
        p = np.linalg.eigvals(system[0])
        x = 1j * centre[finite]
        x, p = (x, p) if dt is None else (np.expm1(x), p - 1.0)
        margin = 0.05 * np.abs(x[:, None] - p).min(1)
        bracket = np.maximum(bracket[0] - margin, 0.0), bracket[1] + margin
    centre[finite] = zoomed(evaluate, system, dt, *bracket)
    values = np.empty(len(centre))
    values[finite] = extended_gain(system, centre[finite], dt)
    values[~finite] = largest(system[3][None])
    dips = np.append(np.minimum.reduceat(s, top)[:-1], 0.0)
    if evaluate is extended_gain:
        dips[:] = np.inf  # the samples dip by rounding alone
    return distinct(system, dt, centre, values, dips)


def careful_gain(system: Matrices, dt: float | None) -> Callable:
    """Extended precision where rounding would move the peaks."""
    p = np.linalg.eigvals(system[0])
    depth = np.abs(p.real) if dt is None else np.abs(np.abs(p) - 1.0)
    return extended_gain if depth.min() < 1e-5 * np.abs(p).max() else gain


def zoomed(
    function: Callable,
    system: Matrices,
    dt: float | None,
    lower: NDArray,
    upper: NDArray,
) -> NDArray:
    """Maximiser in each bracket, which shrinks by four a step."""
    column = np.arange(len(lower))
    for _ in range(7):
        grid = np.linspace(lower, upper, 9)
        values = function(system, grid.ravel(), dt).reshape(grid.shape)
        best = np.clip(values.argmax(0), 1, 7)
        lower, upper = grid[best - 1, column], grid[best + 1, column]
    # The vertex of the parabola through the last three, if they turn down.
    left, top, right = (values[best + k, column] for k in (-1, 0, 1))
    bend = left - 2.0 * top + right
    shift = 0.5 * (left - right) / np.where(bend < 0, bend, np.inf)
    inner = grid[best, column] + np.clip(shift, -1, 1) * (upper - lower) / 2.0
    edge = grid[values.argmax(0), column]
    return np.where((top >= left) & (top >= right), inner, edge)


def distinct(
    system: Matrices, dt: float | None, w: NDArray, s: NDArray, dips: NDArray
) -> tuple[NDArray, NDArray]:
    """Keep the maxima that stand out; rounding makes many on a constant gain."""
    kept, dip, evaluate = [0], np.inf, careful_gain(system, dt)
    for i in range(1, len(w)):
        dip = min(dip, dips[i - 1])
        a, b = w[kept[-1]], w[i]
        if np.isinf(b):
            path = np.geomspace(a + 1e-300, 1e6 * a + 1e-300, 33)
        else:
            path = np.append(np.linspace(a, b, 17), np.sqrt(a * b))
        dip = min(dip, evaluate(system, path, dt).min())
        if dip < min(s[i], s[kept[-1]]) * (1.0 - 1e-9):
            kept.append(i)
            dip = np.inf
        elif s[i] > s[kept[-1]]:
            kept[-1] = i
            dip = np.inf
    return w[kept], s[kept]


# -------------------------------------------------------------- comparison


@dataclass(frozen=True)
class Verdict:
    """Relative errors of one system."""

    low: float
    high: float
    all_peaks: float
    missed: int
    false: int


def judged(case: Case, compute: Callable = linf_norm) -> Verdict:
    """Compare one system with the reference."""
    peaks = compute(*case.system, dt=case.dt, within=WITHIN)
    alone = compute(*case.system, dt=case.dt)
    unit = 1.0 if case.dt is None else case.dt
    w_ref, s_ref = reference_peaks(case.system, case.dt)
    w, s = peaks.frequencies * unit, peaks.values
    # The gain at any frequency bounds the norm from below.
    attained = extended_gain(case.system, w[np.isfinite(w)], case.dt)
    norm = max(s_ref.max(), attained.max(initial=0.0))
    missed = 0
    for w0, s0 in zip(w_ref, s_ref, strict=True):
        if s0 >= (1.0 - WITHIN) * norm * (1.0 + 1e-6):
            missed += not same_peak(case, w0, s0, w, s).any()
    false = sum(
        np.isfinite(w0) and not is_maximum(case, w0, s0)
        for w0, s0 in zip(w, s, strict=True)
    )
    return Verdict(
        low=1.0 - alone.norm / norm,
        high=alone.norm / norm - 1.0,
        all_peaks=abs(peaks.norm / norm - 1.0),
        missed=missed,
        false=false,
    )


def is_maximum(case: Case, w0: float, s0: float) -> bool:
    """Whether the gain falls, or stays, on both sides at every small distance."""
    p = np.linalg.eigvals(case.system[0])
    p = p if case.dt is None else p - 1.0
    x0 = 1j * w0 if case.dt is None else np.expm1(1j * w0)
    reach = np.abs(x0 - p).min() * 10.0 ** np.arange(-6.0, -2.0)
    w = np.abs(np.concatenate((w0 - reach, w0 + reach)))
    return bool(
        (
            careful_gain(case.system, case.dt)(case.system, w, case.dt)
            <= s0 * (1.0 + TOLERANCE)
        ).all()
    )


def same_peak(case: Case, w0: float, s0: float, w: NDArray, s: NDArray) -> NDArray:
    """Equal height, and no dip of the gain on the way from one to the other."""
    near = np.abs(s / s0 - 1.0) <= 1e-7
    p = np.linalg.eigvals(case.system[0])
    x = 1j * w0 if case.dt is None else np.exp(1j * w0)
    close = 1e-3 * np.abs(x - p).min() if np.isfinite(w0) else 0.0
    for i in np.flatnonzero(near):
        if w0 == w[i] or abs(w0 - w[i]) <= close:
            continue
        a, b = sorted((w0, w[i]))
        path = np.geomspace(max(a, 1e-9 * min(b, 1e300)), min(b, 1e6 * a + 1e-300), 33)
        path = path if np.isinf(b) else np.linspace(a, b, 33)
        lowest = careful_gain(case.system, case.dt)(case.system, path, case.dt).min()
        near[i] = lowest >= min(s0, s[i]) * (1.0 - 1e-7)
    return near


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    count: dict[str, int] = defaultdict(int)
    worst: dict[str, NDArray] = defaultdict(lambda: np.zeros(5))
    failures = []
    start = time.perf_counter()
    for i, case in enumerate(cases(options.systems, options.seed)):
        v = judged(case)
        row = np.array([v.low, v.high, v.all_peaks, v.missed > 0, v.false > 0])
        count[case.family] += 1
        worst[case.family][:3] = np.maximum(worst[case.family][:3], row[:3])
        worst[case.family][3:] += row[3:]
        if max(row[:3]) > TOLERANCE or row[3:].any():
            failures.append((i, case.family, v))
    print(f"{'family':28s} count  low      high     peaks    missed false")
    for family, n in count.items():
        low, high, both, missed, false = worst[family]
        print(
            f"{family:28s} {n:5d}  {low:.1e}  {high:.1e}  {both:.1e}"
            f"  {missed:5.0f} {false:5.0f}"
        )
    for failure in failures[:40]:
        print(*failure)
    print(f"{len(failures)} failures, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
