"""How near `SubspaceLTI` comes to what noisy data allow: accuracy, orders, bands.

    python tests/benchmarks/noisy_identification.py STUDY [seed]

with one of the studies

`accuracy`: relative H2 error of models of known order under noise of several kinds,
root mean square, median and worst over runs, beside its lower bound (root mean square,
Cramer and Rao, noise known), the plain simulation error and, where it is installed,
MOESP of SLICOT (`ctrlsys`). `orders`: loss in best fit on fresh data against the best
of the orders 0 to 12 given by hand, over 80 random systems of 0 to 40 dB, 200 to 5,000
samples, half of them in AR(1) noise. `coverage`: share of true values within 95 % bands
of poles and responses, of one record and of six with the same input: their mean, and a
pipeline's average. `time`: processor time of all choices. `awkward`: best fit on fresh
data of records that are sampled far too fast, rounded, or of many resonances.
`disturbances`: best fit on fresh data where noise moves the plant itself, or passes
through another system, by what the default does and by either method. `drift`: best fit
on fresh data where outputs wander, and where noise is slow but stays, and how many
standard deviations the static gain is off.
"""

from __future__ import annotations

import sys
import time
import warnings
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import linalg, signal
from scipy.signal import lfilter

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    bft_score,
)

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
    process: float = 0.0  # of noise that moves the states, relative, in addition

    def __str__(self) -> str:
        return f"{self.name}, {self.order} {self.n_outputs}x{self.n_inputs}"

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
        u, (y,) = self.records(seed, 1)
        return u, y

    def records(self, seed: int, n_records: int) -> tuple[Array, list[Array]]:
        """The same for all of them: inputs; and the outputs of each."""
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((self.n_samples, self.n_inputs))
        clean = self.system().simulate(u)
        size = clean.std(axis=0)
        return u, [clean + size * self._noise(rng) for _ in range(n_records)]

    def _noise(self, rng) -> Array:
        e = rng.standard_normal((self.n_samples + 500, self.n_outputs))
        columns = [
            size * lfilter([np.sqrt(1 - pole**2)], [1, -pole], column)
            for (size, pole), column in zip(self.filters(), e.T, strict=True)
        ]
        v = np.transpose(columns)
        if self.process:
            A, C = self.system().A, self.system().C
            moved = StateSpace(A, np.eye(self.order), C, sampling_time=1.0)
            w = moved.simulate(rng.standard_normal((len(v), self.order)))
            v = v + self.process * w / w[500:].std(axis=0)
        return v[500:]

    def whitened(self, y: Array, size: Array) -> Array:
        """Outputs of that size by the deviation of noise, without its colour."""
        columns = [
            lfilter([1, -pole], [noise * one * np.sqrt(1 - pole**2)], column)
            for (noise, pole), one, column in zip(
                self.filters(), size, y.T, strict=True
            )
        ]
        return np.concatenate(columns)


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


def _timed(model: SubspaceLTI, u: Array, y: Array) -> tuple[float, SubspaceLTI]:
    start = time.process_time()
    model.fit(u, y)
    return time.process_time() - start, model


def _fit(model: SubspaceLTI, fresh: Array, target: Array) -> float:
    """Best fit, percent, on fresh inputs and outputs without noise."""
    return float(bft_score(target, model.lti_.simulate(fresh)))


def _spread(fits: Array) -> str:
    """Mean, median and worst."""
    figures = (np.mean(fits), np.median(fits), np.min(fits))
    return " ".join(f"{figure:5.1f}" for figure in figures)


def bound(case: Case, seed: int) -> float:
    """Root mean square of the relative error of an efficient estimate of a record.

    Cramer and Rao: the derivatives of its outputs by all entries of the matrices, of
    which order (inputs + outputs) directions and D are not changes of the state basis.
    """
    u, _ = case.record(seed)
    truth, n = case.system(), case.order
    size = truth.simulate(u).std(axis=0)
    entries = np.block([[truth.A, truth.B], [truth.C, truth.D]])

    def model(S: Array) -> StateSpace:
        return StateSpace(S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:], 1.0)

    outputs, responses = [], []
    for h in 1e-6 * np.eye(entries.size).reshape(-1, *entries.shape):
        above, below = model(entries + h), model(entries - h)
        gap = above.simulate(u) - below.simulate(u)
        outputs.append(case.whitened(gap, size))
        gap = above.frequency_response(OMEGA) - below.frequency_response(OMEGA)
        responses.append(gap.ravel())
    _, s, Vt = linalg.svd(np.transpose(outputs), full_matrices=False)
    known = n * (case.n_inputs + case.n_outputs) + truth.D.size
    error = np.transpose(responses) @ (Vt[:known].T / s[:known])
    return linalg.norm(error) / linalg.norm(truth.frequency_response(OMEGA))


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


def accuracy(first: int, n_runs: int = 20) -> None:
    """Errors under noise of several kinds."""
    print(f"{'case':28s} {'model':16s} {'rms':>7s} {'median':>7s} {'worst':>7s}")
    for case in CASES:
        truth, order = case.system(), case.order
        fits = {
            "all automatic": SubspaceLTI(),
            "order given": SubspaceLTI(order),
            "simulation error": SubspaceLTI(order, refine="simulation"),
            "not refined": SubspaceLTI(order, refine=False),
        }
        ways = {
            name: lambda u, y, fit=fit: fit.fit(u, y).lti_ for name, fit in fits.items()
        }
        if ctrlsys is not None:
            ways["SLICOT"] = lambda u, y, case=case: slicot(case, u, y)
        runs = range(first, first + n_runs)
        limit = np.sqrt(np.mean([bound(case, run) ** 2 for run in runs]))
        print(f"{case!s:28s} {'bound':16s} {limit:7.4f}")
        for name, way in ways.items():
            e = [relative_error(way(*case.record(run)), truth) for run in runs]
            rms = np.sqrt(np.mean(np.square(e)))
            figures = " ".join(f"{x:7.4f}" for x in (rms, np.median(e), max(e)))
            print(f"{'':28s} {name:16s} {figures}", flush=True)


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

        by_hand = []
        for order in range(13):
            try:
                by_hand.append(_fit(SubspaceLTI(order).fit(u, y), fresh, target))
            except ValueError:
                break  # too few samples for the order
        took, chosen = _timed(SubspaceLTI(), u, y)
        seconds += took
        losses.append(max(by_hand) - _fit(chosen, fresh, target))
    losses = np.array(losses)
    print(
        f"{n_systems} systems: loss mean {losses.mean():.3f}, median "
        f"{np.median(losses):.3f}, positive part "
        f"{np.maximum(losses, 0).mean():.3f}, worst {np.sort(losses)[-3:].round(2)}; "
        f"{seconds:.1f} CPU seconds"
    )


BANDS = (
    *(case._replace(n_samples=1000) for case in CASES[:4]),
    CASES[5],
    Case("process noise", 3, 1, 2, 1000, 15, (0.0,), process=0.2),
)
N_AVERAGED = 6
SEEN = np.linspace(0.05, 3.0, 12)


def coverage(first: int, n_runs: int = 200) -> None:
    """Shares within 95 % bands: all, with what chance leaves open, and least one's."""
    print(f"{'case':28s} {'model':10s} {'responses':>14s} least {'poles':>14s} least")
    for case in BANDS:
        for name, way in (("one", _one), ("mean", _mean), ("average", _average)):
            runs = [way(case, seed) for seed in range(first, first + n_runs)]
            cells = []
            for hits in map(np.array, zip(*runs, strict=True)):
                chance = 1.96 * hits.mean(axis=1).std() / np.sqrt(n_runs)
                share, least = hits.mean(), hits.mean(axis=0).min()
                cells.append(
                    f"{100 * share:7.1f} +- {100 * chance:3.1f} {100 * least:5.1f}"
                )
            print(f"{case!s:28s} {name:10s} {' '.join(cells)}", flush=True)


def _one(case: Case, seed: int) -> tuple[Array, Array]:
    """Which parts of a response, and of the poles, are in their bands."""
    return _in_bands(case, *case.record(seed))


def _mean(case: Case, seed: int) -> tuple[Array, Array]:
    """The same from the mean of six records."""
    u, records = case.records(seed, N_AVERAGED)
    return _in_bands(case, u, np.mean(records, axis=0))


def _in_bands(case: Case, u: Array, y: Array) -> tuple[Array, Array]:
    truth, model = case.system(), SubspaceLTI(case.order).fit(u, y)
    gap = model.lti_.frequency_response(SEEN) - truth.frequency_response(SEEN)
    poles, found = truth.poles(), model.lti_.poles()
    poles = poles[poles.imag >= 0.0]
    nearest = np.abs(found - poles[:, None]).argmin(axis=1)
    hits = _inside(found[nearest] - poles, model.poles_std_[nearest])
    moves = np.concatenate([poles, poles.imag]) != 0.0  # a real one's imaginary part
    return _inside(gap, model.frequency_response_std(SEEN)), hits[moves]


def _inside(gap: Array, std: Array) -> Array:
    """Whether (real and imaginary parts) are within a 95 % band."""
    gap, std = (np.concatenate([v.real.ravel(), v.imag.ravel()]) for v in (gap, std))
    return np.abs(gap) <= 1.96 * std


def _average(case: Case, seed: int) -> tuple[Array, Array]:
    """The same of what a pipeline makes of six, in a form of poles as parameters."""
    truth = case.system().to_continuous()
    poles = truth.poles()
    pairs, lags = poles[poles.imag > 0.0], poles[poles.imag == 0.0]
    pairs = pairs[np.argsort(abs(pairs))]
    sizes = (len(pairs), case.n_inputs, case.n_outputs, len(lags))
    u, records = case.records(seed, N_AVERAGED)
    inputs = [f"u{i}" for i in range(case.n_inputs)]
    table = pd.DataFrame(np.tile(u, (N_AVERAGED, 1)), columns=inputs)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(case.order),
        GrayBoxRestructurer(GrayBoxStructure.modal(*sizes, feedthrough=True)),
        inputs=inputs,
        experiment="run",
        sampling_time=1.0,
        combine="average",
    ).fit(table.assign(run=table.index // len(u)), np.vstack(records))
    model, (place,) = pipeline.structured_models_[0], pipeline.operating_points_
    gap = model.frequency_response(SEEN) - truth.frequency_response(SEEN)
    values, std = pipeline.parameters_.iloc[0], pipeline.parameters_std_.iloc[0]
    modes = np.argsort(values.filter(regex="^w2_").to_numpy())
    parts = (
        ("w2", modes, abs(pairs) ** 2),
        ("d", modes, -2.0 * pairs.real),
        ("r", slice(None), -lags.real),
    )
    hits = []
    for symbol, places, true in parts:
        found, wide = (
            v.filter(regex=f"^{symbol}_").to_numpy()[places] for v in (values, std)
        )
        hits.append(np.abs(found - true) <= 1.96 * wide)
    return (
        _inside(gap, pipeline.lpv_.frequency_response_std(place, SEEN)),
        np.concatenate(hits),
    )


def times(first: int, n_runs: int = 5) -> None:
    """Processor time of a fit with all choices by that of one that is told them."""
    print(f"{'case':28s} {'all s':>7s}  by order and method given   by horizon, too")
    for case in CASES:
        spent = []
        for seed in range(first, first + n_runs):
            u, y = case.record(seed)
            seconds, auto = _timed(SubspaceLTI(), u, y)
            told = {"order": auto.order_, "method": auto.method_}
            row = [seconds, _timed(SubspaceLTI(**told), u, y)[0]]
            told["horizon"] = auto.horizon_
            spent.append([*row, _timed(SubspaceLTI(**told), u, y)[0]])
        spent = np.transpose(spent)
        cells = [f"{np.median(spent[0]):7.3f}"]
        for ratio in spent[0] / spent[1:]:
            cells.append(f"median {np.median(ratio):4.1f}, worst {max(ratio):4.1f}")
        print(f"{case!s:28s} {'      '.join(cells)}", flush=True)


def disturbances(first: int, n_runs: int = 16) -> None:
    """Best fit where noise moves the plant, or passes through another system."""
    print("noise                  pbsid  auto  po-moesp  pbsid  [mean, median, worst]")
    for name in ("light modes, 0 dB", "light modes, 14 dB", "plant", "another"):
        fits, taken = [], 0
        for seed in range(first, first + n_runs):
            u, y, fresh, target = _disturbed(name, np.random.default_rng(seed))
            row = []
            for method in ("auto", "po-moesp", "pbsid"):
                model = SubspaceLTI(method=method).fit(u, y)
                taken += method == "auto" and model.method_ == "pbsid"
                row.append(_fit(model, fresh, target))
            fits.append(row)
        shown = "  ".join(map(_spread, np.transpose(fits)))
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
    print("record                            mean median worst  orders         CPU s")
    for name in _AWKWARD:
        fits, found, seconds = [], [], []
        for seed in range(first, first + n_runs):
            u, y, fresh, target = _AWKWARD[name](np.random.default_rng(seed))
            took, model = _timed(SubspaceLTI(), u, y)
            seconds.append(took)
            fits.append(_fit(model, fresh, target))
            found.append(model.order_)
        shown, took = f"{min(found)} to {max(found)}", np.median(seconds)
        print(f"{name:32s} {_spread(fits)}  {shown:12s} {took:5.1f}", flush=True)


def drift(first: int, n_runs: int = 12) -> None:
    """Best fit, and static gains by their deviations, of outputs that wander."""
    print("constants to  noise       mean median worst  gains off: median, > 3  CPU s")
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
                took, model = _timed(SubspaceLTI(sampling_time=1.0), u, y)
                seconds += took
                fits.append(_fit(model, fresh, target))
                try:
                    std = abs(model.frequency_response_std([1e-6]).item())
                except ValueError:  # kept stable: no deviations
                    continue
                if not std:  # nothing was found
                    continue
                gap = model.lti_.frequency_response([1e-6]).item()
                off.append(abs(gap - plant.frequency_response([1e-6]).item()) / std)
            print(
                f"{slowest:12.0f}  {kind:10s} {_spread(fits)} "
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
    "time": times,
    "disturbances": disturbances,
    "drift": drift,
}

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    STUDIES[sys.argv[1]](int(sys.argv[2]) if len(sys.argv) > 2 else 0)
