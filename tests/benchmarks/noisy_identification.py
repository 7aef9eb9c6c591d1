"""How near `SubspaceLTI` comes to what noisy data allow: accuracy, orders, bands.

    python tests/benchmarks/noisy_identification.py STUDY [seed]

with one of the studies

`accuracy`: relative H2 error of models of known order under noise of several kinds,
median and worst over runs, beside its lower bound (root mean square, Cramer and Rao,
spectra known), the plain simulation error and, where it is installed, MOESP of SLICOT
(`ctrlsys`). `orders`: loss in best fit on fresh data against the best of the orders 0
to 12 given by hand, over 80 random systems of 0 to 40 dB, 200 to 5,000 samples, half of
them in AR(1) noise. `coverage`: share of true values within 95 % bands of poles and
responses. `awkward`: best fit on fresh data of records that are sampled far too fast,
rounded, or of many resonances. `disturbances`: best fit on fresh data where noise moves
the plant itself, or passes through another system, by what the default does and by
either method. `drift`: best fit on fresh data where outputs wander, and where noise is
slow but stays, and how many standard deviations the static gain is off.
"""

from __future__ import annotations

import sys
import time
import warnings
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI

try:
    import ctrlsys
except ImportError:
    ctrlsys = None

Array = np.ndarray
OMEGA = np.linspace(1e-3, np.pi, 2000)


def random_system(rng, n, m, ny, slowest=0.97) -> StateSpace:
    """Modes of equal size, each normalised on its own, and a feedthrough."""
    blocks = []
    while sum(map(len, blocks)) < n:
        if n - sum(map(len, blocks)) >= 2 and rng.random() < 0.7:
            pole = rng.uniform(0.5, slowest) * np.exp(1j * rng.uniform(0.1, 2.5))
            a, b = pole.real, pole.imag
            blocks.append(np.array([[a, b], [-b, a]]))
        else:
            blocks.append(np.array([[rng.uniform(-0.3, slowest)]]))
    B, C = rng.standard_normal((n, m)), rng.standard_normal((ny, n))
    start = 0
    for block in blocks:
        part = slice(start, start + len(block))
        P = linalg.solve_discrete_lyapunov(block, B[part] @ B[part].T)
        B[part] /= np.sqrt(np.trace(C[:, part] @ P @ C[:, part].T))
        start += len(block)
    D = 0.3 * rng.standard_normal((ny, m))
    return StateSpace(linalg.block_diag(*blocks), B, C, D, sampling_time=1.0)


class Case(NamedTuple):
    """A system, and the noise in its outputs."""

    name: str
    order: int
    n_inputs: int
    n_outputs: int
    n_samples: int
    decibel: float
    poles: tuple[float, ...]  # of the noise of each output, cyclically
    sizes: tuple[float, ...] = (1.0,)  # of the noise, relative
    slow: float = 0.0  # the slowest pole, beside those drawn, where there is one

    def system(self) -> StateSpace:
        """The same for all seeds; its poles can be told apart."""
        if self.slow:
            A = np.diag([self.slow, 0.7])
            B = np.array([[np.sqrt(1.0 - self.slow**2)], [0.7]])
            return StateSpace(A, B, np.ones((1, 2)), None, 1.0)
        rng = np.random.default_rng(2024 + self.order + 10 * self.n_outputs)
        while True:
            system = random_system(rng, self.order, self.n_inputs, self.n_outputs)
            poles = system.poles()
            gaps = np.abs(poles - poles[:, None]) + np.eye(self.order)
            if gaps.min() > 0.15 and np.abs(poles).min() > 0.3:
                return system

    def filters(self) -> list[tuple[float, float]]:
        """Size and pole of the noise of every output, of unit variance."""
        return [
            (
                self.sizes[i % len(self.sizes)] * 10 ** (-self.decibel / 20),
                self.poles[i % len(self.poles)],
            )
            for i in range(self.n_outputs)
        ]

    def record(self, seed: int) -> tuple[Array, Array]:
        """White inputs, noisy outputs."""
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((self.n_samples, self.n_inputs))
        y = self.system().simulate(u)
        e = rng.standard_normal((self.n_samples + 500, self.n_outputs))
        for i, (size, pole) in enumerate(self.filters()):
            v = lfilter([np.sqrt(1 - pole**2)], [1, -pole], e[:, i])[500:]
            y[:, i] += size * y[:, i].std() * v
        return u, y


CASES = [
    Case("white", 4, 2, 2, 500, 10, (0.0,)),
    Case("AR(.9)", 3, 1, 1, 500, 10, (0.9,)),
    Case("AR(.9)", 4, 2, 2, 500, 10, (0.9,)),
    Case("AR(.9) and white", 4, 2, 2, 500, 10, (0.9, 0.0)),
    Case("AR(.9)", 8, 2, 2, 2000, 10, (0.9,)),
    Case("1 % and 100 %", 4, 2, 2, 2000, 0, (0.0,), (0.01, 1.0)),
    Case("white, pole 1 - 1e-4", 2, 1, 1, 4000, 10, (0.0,), slow=1 - 1e-4),
    Case("AR(.9), pole 1 - 1e-4", 2, 1, 1, 4000, 10, (0.9,), slow=1 - 1e-4),
]


def relative_error(found: StateSpace, truth: StateSpace) -> float:
    """H2 norm of the difference by that of the truth, on a grid."""
    gap = found.frequency_response(OMEGA) - truth.frequency_response(OMEGA)
    return linalg.norm(gap) / linalg.norm(truth.frequency_response(OMEGA))


def bound(case: Case) -> float:
    """Root mean square of the relative error of an efficient estimate.

    By spectra, which those of records shorter than a transient are not.
    """
    if case.slow:
        return np.nan
    truth = case.system()
    A, B, C, D = truth.A, truth.B, truth.C, truth.D
    z = np.exp(1j * OMEGA)
    R = np.linalg.inv(z[:, None, None] * np.eye(len(A)) - A)
    left, right = C @ R, R @ B
    eye_m, eye_y = np.eye(B.shape[1]), np.eye(len(C))
    J = [
        np.einsum("foi,fjm->fomij", left, right),
        np.einsum("foi,mj->fomij", left, eye_m),
        np.einsum("op,fjm->fompj", eye_y, right),
        np.broadcast_to(
            np.einsum("op,mj->ompj", eye_y, eye_m), (len(z), *D.shape, *D.shape)
        ),
    ]
    J = np.concatenate([part.reshape(*part.shape[:3], -1) for part in J], axis=3)
    size = truth.simulate(
        np.random.default_rng(0).standard_normal((20_000, B.shape[1]))
    ).std(axis=0)
    density = np.array(
        [
            (s * size[i]) ** 2 * (1 - p**2) / abs(1 - p / z) ** 2
            for i, (s, p) in enumerate(case.filters())
        ]
    )
    weighted = J / density.T[:, :, None, None]
    information = np.einsum("fomp,fomq->pq", weighted.conj(), J).real
    information *= case.n_samples / len(z)
    covariance = np.linalg.pinv(information, rcond=1e-10, hermitian=True)
    variance = np.einsum("fomp,pq,fomq->", J.conj(), covariance, J).real
    return float(np.sqrt(variance) / linalg.norm(truth.frequency_response(OMEGA)))


def slicot(case: Case, u: Array, y: Array) -> StateSpace:
    """MOESP with the initial state and B, D by simulation."""
    n, (m, ny) = case.order, (u.shape[1], y.shape[1])
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    horizon = max(10, 2 * n)
    _, R, *_ = ctrlsys.ib01ad(
        "M", "Q", "M", "O", "N", "N", horizon, m, ny, u.copy("F"), y.copy("F"), 0, -1
    )
    A, C, B, D, *_ = ctrlsys.ib01bd("M", "A", "N", horizon, n, m, ny, len(u), R, 0.0)
    found = ctrlsys.ib01cd("X", "C", "D", n, m, ny, A, B, C, D, u, y, 0.0)
    return StateSpace(A, found[1], C, found[2], sampling_time=1.0)


def accuracy(first: int) -> None:
    """Errors under noise of several kinds."""
    print(f"{'case':26s} {'bound':>7s}  rms, median, worst of 20 runs")
    for case in CASES:
        truth = case.system()
        fits = {
            "auto": lambda u, y, n=case.order: SubspaceLTI(n).fit(u, y).lti_,
            "all automatic": lambda u, y: SubspaceLTI().fit(u, y).lti_,
            "simulation": lambda u, y, n=case.order: (
                SubspaceLTI(n, refine="simulation").fit(u, y).lti_
            ),
            "none": lambda u, y, n=case.order: (
                SubspaceLTI(n, refine=False).fit(u, y).lti_
            ),
        }
        if ctrlsys is not None:
            fits["SLICOT"] = lambda u, y, case=case: slicot(case, u, y)
        cells = []
        for name, fit in fits.items():
            e = [relative_error(fit(*case.record(first + i)), truth) for i in range(20)]
            rms = np.sqrt(np.mean(np.square(e)))
            cells.append(f"{name} {rms:.4f} {np.median(e):.4f} {max(e):.4f}")
        label = f"{case.name}, {case.order} {case.n_outputs}x{case.n_inputs}"
        print(f"{label:26s} {bound(case):7.4f}  {'; '.join(cells)}", flush=True)


def orders(first: int, n_systems: int = 80) -> None:
    """Loss of the automatic order."""
    losses, seconds = [], 0.0
    for i in range(n_systems):
        rng = np.random.default_rng(first + i)
        n, m, ny = int(rng.integers(1, 9)), *rng.integers(1, 3, 2)
        truth = random_system(rng, n, m, ny)
        n_samples = int(np.exp(rng.uniform(np.log(200), np.log(5000))))
        decibel, pole, kind = rng.uniform(0, 40), 0.9 * (i % 2), rng.integers(3)

        def inputs(n_samples, rng=rng, m=m, kind=kind):
            white = rng.standard_normal((n_samples, m))
            if kind == 1:
                return np.sign(white[: n_samples // 3 + 1]).repeat(3, 0)[:n_samples]
            return lfilter([0.6], [1, -0.8], white, axis=0) if kind else white

        u, fresh = inputs(n_samples), inputs(3000)
        y = truth.simulate(u)
        e = rng.standard_normal((n_samples + 300, ny))
        v = lfilter([np.sqrt(1 - pole**2)], [1, -pole], e, axis=0)[300:]
        y = y + v * y.std(axis=0) * 10 ** (-decibel / 20)
        target = truth.simulate(fresh)

        def best_fit(model, fresh=fresh, target=target):
            miss = target - model.simulate(fresh)
            share = linalg.norm(miss, axis=0) / linalg.norm(
                target - target.mean(axis=0), axis=0
            )
            return 100 * np.maximum(1 - share, 0).mean()

        by_hand = []
        for order in range(13):
            try:
                by_hand.append(best_fit(SubspaceLTI(order).fit(u, y).lti_))
            except ValueError:
                break  # too few samples for the order
        start = time.process_time()
        chosen = SubspaceLTI().fit(u, y)
        seconds += time.process_time() - start
        losses.append(max(by_hand) - best_fit(chosen.lti_))
    losses = np.array(losses)
    print(
        f"{n_systems} systems: loss mean {losses.mean():.3f}, median "
        f"{np.median(losses):.3f}, positive part "
        f"{np.maximum(losses, 0).mean():.3f}, worst {np.sort(losses)[-3:].round(2)}; "
        f"{seconds:.1f} CPU seconds"
    )


def coverage(first: int, n_runs: int = 100) -> None:
    """Shares within 95 % bands."""
    omega = np.linspace(0.05, 3.0, 12)
    process = Case("process noise", 3, 1, 2, 1000, 15, (0.0,))
    for case in (*(c._replace(n_samples=1000) for c in CASES[:4]), CASES[5], process):
        truth = case.system()
        poles, inside_r, inside_p = np.sort_complex(truth.poles()), [], []
        G = truth.frequency_response(omega)
        for i in range(n_runs):
            u, y = case.record(first + i)
            if case is process:
                rng = np.random.default_rng(first + 10_000 + i)
                w = rng.standard_normal((len(u) + 200, case.order))
                states = StateSpace(
                    truth.A, np.eye(case.order), truth.C, sampling_time=1.0
                )
                v = states.simulate(w)[200:]
                y = y + 0.2 * y.std(axis=0) * v / v.std(axis=0)
            model = SubspaceLTI(case.order).fit(u, y)
            gap = model.lti_.frequency_response(omega) - G
            std = model.frequency_response_std(omega)
            inside_r.append(np.mean(np.abs(gap.real) <= 1.96 * std.real))
            inside_r.append(np.mean(np.abs(gap.imag) <= 1.96 * std.imag))
            by_pole = np.argsort(model.lti_.poles())
            gap = model.lti_.poles()[by_pole] - poles
            std = model.poles_std_[by_pole]
            inside_p.append(np.mean(np.abs(gap.real) <= 1.96 * std.real))
        print(
            f"{case.name:18s} responses {100 * np.mean(inside_r):.1f} %, "
            f"poles {100 * np.mean(inside_p):.1f} %",
            flush=True,
        )


def disturbances(first: int, n_runs: int = 16) -> None:
    """Best fit where noise moves the plant, or passes through another system."""
    print("noise                      auto  (pbsid)  po-moesp  pbsid  [mean, worst]")
    for name in ("light modes, 0 dB", "light modes, 14 dB", "plant", "another"):
        fits, taken = [], 0
        for seed in range(first, first + n_runs):
            u, y, fresh, target = _disturbed(name, np.random.default_rng(seed))
            row = []
            for method in ("auto", "po-moesp", "pbsid"):
                model = SubspaceLTI(method=method).fit(u, y)
                taken += method == "auto" and model.method_ == "pbsid"
                miss = target - model.lti_.simulate(fresh)
                share = linalg.norm(miss, axis=0) / linalg.norm(
                    target - target.mean(axis=0), axis=0
                )
                row.append(100 * np.maximum(1 - share, 0).mean())
            fits.append(row)
        mean, worst = np.mean(fits, axis=0), np.min(fits, axis=0)
        shown = "  ".join(
            f"{a:5.1f} {b:5.1f}" for a, b in zip(mean, worst, strict=True)
        )
        print(f"{name:20s} {taken:3d} of {n_runs}  {shown}", flush=True)


def _disturbed(name: str, rng) -> tuple[Array, Array, Array, Array]:
    """Inputs and noisy outputs, fresh inputs and outputs."""
    if name.startswith("light"):
        zeta, clock, n = 10 ** rng.uniform(-1.7, -0.5), int(rng.integers(2, 41)), 3000
        mode, gain = (
            np.array([[0.0, 1.0], [-0.49, -1.4 * zeta]]),
            np.array([[0.0], [1]]),
        )
        lagged = linalg.block_diag(mode, [[-0.1]])
        lagged[1, 2] = 1.0
        plant = StateSpace(lagged, np.eye(3)[:, 2:], np.eye(3)[:1]).to_discrete(0.2)
        shaken = StateSpace(mode, gain, np.eye(2)[:1]).to_discrete(0.2)
        u, fresh = (
            rng.choice([-1.0, 1.0], size=(size // clock + 1, 1)).repeat(clock, 0)[:size]
            for size in (n, 1500)
        )
        decibel = float(name.split()[2])
    else:
        n, order, ny = 1500, int(rng.integers(2, 7)), int(rng.integers(1, 3))
        plant, decibel = random_system(rng, order, 1, ny), 10.0 * (rng.random() < 0.5)
        if name == "plant":
            K = rng.standard_normal((order, ny))
            shaken = StateSpace(plant.A, K, plant.C, np.zeros((ny, ny)), 1.0)
        else:
            shaken = random_system(rng, int(rng.integers(2, 6)), ny, ny)
        u, fresh = rng.standard_normal((n, 1)), rng.standard_normal((2000, 1))
    y = plant.simulate(u)
    v = shaken.simulate(rng.standard_normal((n + 1000, shaken.n_inputs)))[1000:]
    v = v / v.std(axis=0) + 0.05 * rng.standard_normal(v.shape)
    y = y + y.std(axis=0) * 10 ** (-decibel / 20) * v
    return u, y, fresh, plant.simulate(fresh)


def awkward(first: int, n_runs: int = 8) -> None:
    """Best fit of records sampled far too fast, of many resonances, or rounded."""
    print("record                             mean  worst  orders         CPU s")
    for name in _AWKWARD:
        fits, found, seconds = [], [], []
        for seed in range(first, first + n_runs):
            u, y, fresh, target = _AWKWARD[name](np.random.default_rng(seed))
            start = time.process_time()
            model = SubspaceLTI().fit(u, y)
            seconds.append(time.process_time() - start)
            miss = linalg.norm(target - model.lti_.simulate(fresh))
            fits.append(100.0 * (1.0 - miss / linalg.norm(target - target.mean())))
            found.append(model.order_)
        mean, worst = np.mean(np.maximum(fits, 0.0)), np.min(fits)
        shown = f"{min(found)} to {max(found)}"
        took = f"{np.median(seconds):5.1f}"
        print(f"{name:34s} {mean:5.1f}  {worst:5.1f}  {shown:12s} {took}", flush=True)


def drift(first: int, n_runs: int = 12) -> None:
    """Best fit, and static gains by their deviations, of outputs that wander."""
    print("time constants to  noise       mean  worst  gains off: median, > 3  CPU s")
    for slowest in (40.0, 400.0):
        for kind in _SLOW_NOISE:
            fits, off, seconds = [], [], 0.0
            for seed in range(first, first + n_runs):
                rng = np.random.default_rng(seed)
                plant = _slow_plant(rng, slowest)
                n_samples = int(np.exp(rng.uniform(np.log(300), np.log(3000))))
                u, fresh = (_held_or_not(rng, n) for n in (n_samples, 2000))
                y, target = plant.simulate(u), plant.simulate(fresh)
                v = _SLOW_NOISE[kind](rng, n_samples)[:, None]
                y = y + y.std() * v + 5.0 * y.std() * (rng.random() < 0.5)
                start = time.process_time()
                model = SubspaceLTI(sampling_time=1.0).fit(u, y)
                seconds += time.process_time() - start
                miss = linalg.norm(target - model.lti_.simulate(fresh))
                spread = linalg.norm(target - target.mean())
                fits.append(max(100.0 * (1.0 - miss / spread), 0.0))
                try:
                    std = abs(model.frequency_response_std([1e-6]).item())
                except ValueError:  # kept stable: no deviations
                    continue
                gap = model.lti_.frequency_response([1e-6]).item()
                off.append(abs(gap - plant.frequency_response([1e-6]).item()) / std)
            print(
                f"{slowest:17.0f}  {kind:10s} {np.mean(fits):5.1f}  {min(fits):5.1f} "
                f"{np.median(off):19.1f}, {np.sum(np.array(off) > 3.0):3d}"
                f"  {seconds / n_runs:5.2f}",
                flush=True,
            )


def _slow_plant(rng, slowest: float) -> StateSpace:
    """One to four states: lags of 3 samples to the slowest, modes of 5 to 30."""
    n, blocks = int(rng.integers(1, 5)), []
    while sum(map(len, blocks)) < n:
        if n - sum(map(len, blocks)) > 1 and rng.random() < 0.4:
            pole = np.exp(complex(-1.0 / rng.uniform(5.0, 30.0), rng.uniform(0.1, 1.0)))
            blocks.append([[pole.real, pole.imag], [-pole.imag, pole.real]])
        else:
            blocks.append([[np.exp(-1.0 / rng.uniform(3.0, slowest))]])
    A, start = linalg.block_diag(*blocks), 0
    B, C = rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    for block in blocks:
        part = slice(start, start + len(block))
        P = linalg.solve_discrete_lyapunov(A[part, part], B[part] @ B[part].T)
        B[part] /= np.sqrt(np.trace(C[:, part] @ P @ C[:, part].T))
        start += len(block)
    return StateSpace(A, B, C, None, 1.0)


def _held_or_not(rng, n_samples: int) -> Array:
    """White, held at one of two levels, or slow."""
    kind = rng.integers(3)
    if kind == 0:
        return rng.standard_normal((n_samples, 1))
    if kind == 1:
        clock = int(rng.integers(5, 40))
        levels = rng.choice([-1.0, 1.0], (n_samples // clock + 1, 1))
        return levels.repeat(clock, axis=0)[:n_samples]
    return lfilter([0.3], [1, -0.9], rng.standard_normal((n_samples, 1)), axis=0)


def _walk(rng, n: int) -> Array:
    return np.cumsum(rng.standard_normal(n)) / np.sqrt(n)


def _lag(pole: float, rng, n: int) -> Array:
    e = rng.standard_normal(n)
    return np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], e)


# relative to the outputs: walks by what they reach at the end
_SLOW_NOISE = {
    "walk": lambda rng, n: 0.5 * _walk(rng, n),
    "large walk": lambda rng, n: 3.0 * _walk(rng, n),
    "and white": lambda rng, n: 0.5 * _walk(rng, n) + 0.07 * rng.standard_normal(n),
    "white": lambda rng, n: 0.1 * rng.standard_normal(n),
    "AR(.9)": lambda rng, n: 0.2 * _lag(0.9, rng, n),
    "AR(.99)": lambda rng, n: 0.3 * _lag(0.99, rng, n),
    "ramp": lambda rng, n: np.linspace(-0.5, 0.5, n) + 0.05 * rng.standard_normal(n),
}


def _too_fast(kind: str, per_period: int, decibel: float):
    """Modes and lags within a decade, so many samples in a period of the fastest."""

    def record(rng):
        n, blocks = int(rng.integers(2, 6)), []
        while sum(map(len, blocks)) < n:
            w, zeta = 10 ** rng.uniform(0, 1), 10 ** rng.uniform(-1.5, -0.3)
            mode = [[0.0, 1.0], [-w * w, -2.0 * zeta * w]]
            oscillates = n - sum(map(len, blocks)) > 1 and rng.random() < 0.7
            blocks.append(np.array(mode if oscillates else [[-w]]))
        A = linalg.block_diag(*blocks)
        B, C = rng.standard_normal((2, n, 1))
        poles = np.linalg.eigvals(A)
        step = 2.0 * np.pi / np.abs(poles).max() / per_period
        plant = StateSpace(A, B, C.T).to_discrete(step)
        lasting = 20.0 / np.abs(poles.real).min() / step
        u, fresh = (
            _inputs(kind, per_period, size, rng)
            for size in (int(np.clip(lasting, 20_000, 60_000)), 20_000)
        )
        y = plant.simulate(u)
        y += y.std() * 10 ** (-decibel / 20) * rng.standard_normal(y.shape)
        return u, y, fresh, plant.simulate(fresh)

    return record


def _inputs(kind: str, per_period: int, size: int, rng) -> Array:
    if kind == "held":
        clock = per_period // 4
        values = rng.choice([-1.0, 1.0], size=(size // clock + 1, 1))
        return values.repeat(clock, axis=0)[:size]
    white = rng.standard_normal((size, 1))
    low_pass = signal.butter(4, min(0.9, 4.0 / per_period), output="sos")
    return signal.sosfilt(low_pass, white, axis=0) if kind == "smooth" else white


def _ladder(rng):
    """Four coils and capacitors, of one resistor at the end; 4,000 samples, 40 dB."""
    n = 8
    A = np.diag(np.tile([-2.0, 0.0], 4))
    for coil in range(0, n, 2):
        A[coil, coil + 1], A[coil + 1, coil] = -1.0, 100.0
        if coil > 0:
            A[coil, coil - 1], A[coil - 1, coil] = 1.0, -100.0
    A[-1, -1] = -1.0
    plant = StateSpace(A, np.eye(n)[:, :1], np.eye(n)[-1:]).to_discrete(0.02)
    u = rng.choice([-1.0, 1.0], (1000, 1)).repeat(4, axis=0)
    fresh, y = rng.standard_normal((2000, 1)), plant.simulate(u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    return u, y, fresh, plant.simulate(fresh)


def _rounded(n_levels: int):
    """A mode that answers to steps, in so many steps of the sensor; 1,000 samples."""

    def record(rng):
        A, B = [[0.0, 1.0], [-0.01, -0.12]], [[0.0], [0.01]]
        plant = StateSpace(A, B, [[1.0, 0.0]]).to_discrete(1.0)
        clocks = rng.integers(36, 84, size=30)
        u = rng.choice([0.0, 1.0], (30, 1)).repeat(clocks, axis=0)[:1000]
        y = plant.simulate(u)
        step = np.ptp(y) / n_levels
        fresh = rng.choice([-1.0, 1.0], (300, 1)).repeat(3, axis=0)
        return u, step * np.round((y + 40.0) / step), fresh, plant.simulate(fresh)

    return record


_AWKWARD = {
    "smooth, 30 in a period, 30 dB": _too_fast("smooth", 30, 30.0),
    "smooth, 500 in a period, 30 dB": _too_fast("smooth", 500, 30.0),
    "held, 500 in a period, 0 dB": _too_fast("held", 500, 0.0),
    "held, 2000 in a period, 10 dB": _too_fast("held", 2000, 10.0),
    "white, 500 in a period, 0 dB": _too_fast("white", 500, 0.0),
    "ladder of order 8": _ladder,
    "order 2, rounded to 10 steps": _rounded(10),
    "order 2, rounded to 40 steps": _rounded(40),
}

STUDIES = {
    "accuracy": accuracy,
    "awkward": awkward,
    "orders": orders,
    "coverage": coverage,
    "disturbances": disturbances,
    "drift": drift,
}

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    STUDIES[sys.argv[1]](int(sys.argv[2]) if len(sys.argv) > 2 else 0)
