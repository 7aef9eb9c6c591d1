"""Identification under feedback, and how often open-loop data are taken for it.

    python tests/benchmarks/closed_loop.py [--runs 20] [--first 0] [--fits 300]

A lightly damped plant of second order, ``u = r - 0.4 y``, its reference r white. Noise:
of the process (it shares the plant's states), of first order (pole .9) at the output,
or white there. For every method the error of the impulse response, relative in norm,
median and worst of the runs; the share of errors of the frequency response within 95 %
bands; and, of "auto", the share of runs in which it took "pbsid" (the power of
the feedback test; white noise behind a delay does not bias, and does not show).

Then open-loop records of random systems, orders 1 to 8, 200 to 20,000 samples, 0 to 60
dB, of twelve kinds of inputs and three of noise: the share of `SubspaceLTI` fits that
warn of feedback, and of a model that lacks something, by what they were given.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import defaultdict

import numpy as np
from scipy.signal import butter, lfilter

from lpvlearn import StateSpace, SubspaceLTI

PLANT = StateSpace([[1.5, -0.7], [1.0, 0.0]], [[1.0], [0.0]], [[0.5, 0.3]], None, 1.0)
GAIN, NOISE_GAIN, NOISE = 0.4, np.array([0.8, 0.4]), 0.5
OMEGA = np.array([0.1, 0.3, 0.5, 1.0, 2.0])

INPUTS = (
    "white",
    "held",
    "binary",
    "multisine",
    "two sines",
    "AR(.9)",
    "AR(.99)",
    "low-pass",
    "levels",
    "telegraph",
    "chirp",
    "walk",
)


def closed_loop(
    rng: np.random.Generator, kind: str, n_samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Input and output of the loop."""
    A, b, c = PLANT.A, PLANT.B[:, 0], PLANT.C[0]
    r, e = rng.standard_normal((2, n_samples)) * [[1.0], [NOISE]]
    v = 0.43 * lfilter([1.0], [1.0, -0.9], e) if kind == "AR(.9)" else e
    x, u, y = np.zeros(2), np.zeros(n_samples), np.zeros(n_samples)
    for t in range(n_samples):
        y[t] = c @ x + v[t]
        u[t] = r[t] - GAIN * y[t]
        x = A @ x + b * u[t] + (kind == "process") * NOISE_GAIN * e[t]
    return u[:, None], y[:, None]


def impulse_response(model: StateSpace, length: int = 400) -> np.ndarray:
    """First samples, longer than they last."""
    impulse = np.zeros((length, 1))
    impulse[0] = 1.0
    return model.simulate(impulse)


def accuracy(runs: range) -> None:
    """Print the errors of every method."""
    truth, at = impulse_response(PLANT), PLANT.frequency_response(OMEGA)
    methods = {"po-moesp": 2, "auto": 2, "pbsid": 2, "pbsid, auto order": "auto"}
    print(
        "noise      samples  method             median   worst   95 %  order 2  pbsid"
    )
    for kind in ("process", "AR(.9)", "white"):
        for n_samples in (2_000, 10_000):
            found = defaultdict(list)
            for run in runs:
                rng = np.random.default_rng([run, n_samples, *kind.encode()])
                u, y = closed_loop(rng, kind, n_samples)
                for name, order in methods.items():
                    fit = SubspaceLTI(
                        order, method=name.split(",")[0], feedthrough=False
                    ).fit(u, y)
                    miss = np.linalg.norm(impulse_response(fit.lti_) - truth)
                    error = fit.lti_.frequency_response(OMEGA) - at
                    band = fit.frequency_response_std(OMEGA)
                    inside = np.mean(
                        [
                            np.abs(error.real) <= 1.96 * band.real,
                            np.abs(error.imag) <= 1.96 * band.imag,
                        ]
                    )
                    found[name].append(
                        (
                            miss / np.linalg.norm(truth),
                            inside,
                            fit.order_ == 2,
                            fit.method_ == "pbsid",
                        )
                    )
            for name, rows in found.items():
                error, inside, right, took = np.array(rows).T
                print(
                    f"{kind:9s} {n_samples:8d}  {name:18s}{np.median(error):7.4f}"
                    f"{error.max():8.4f}{100 * inside.mean():7.1f}"
                    f"{100 * right.mean():9.0f}{100 * took.mean():7.0f}",
                    flush=True,
                )


def signal(rng: np.random.Generator, kind: str, n: int) -> np.ndarray:
    """An input of unit size."""
    t = np.arange(n)
    steps = int(rng.integers(2, 20))
    noise = rng.standard_normal(n + 1000)
    if kind == "held":
        u = np.repeat(noise, steps)[:n]
    elif kind == "binary":
        u = np.repeat(np.sign(noise), steps)[:n]
    elif kind in ("multisine", "two sines"):
        period = int(rng.integers(50, max(51, n // 2)))
        tones = np.arange(1, min(period // 3, 40)) / period
        if kind == "two sines":
            tones = rng.uniform(0.01, 0.2, 2)
        phases = rng.uniform(0.0, 2.0 * np.pi, len(tones))
        u = np.cos(2.0 * np.pi * np.outer(t, tones) + phases).sum(axis=1)
    elif kind.startswith("AR"):
        u = lfilter([1.0], [1.0, -float(kind[3:-1])], noise)[1000:]
    elif kind == "low-pass":
        u = lfilter(*butter(4, 0.1), noise)[1000:]
    elif kind == "levels":
        u = noise[np.cumsum(rng.random(n) < 0.05)]
    elif kind == "telegraph":
        u = np.cumprod(np.where(rng.random(n) < 0.05, -1.0, 1.0))
    elif kind == "chirp":
        u = np.sin(2.0 * np.pi * (0.002 * t + 0.1 * t**2 / n) + rng.uniform(0.0, 6.0))
    elif kind == "walk":
        u = np.clip(np.cumsum(0.2 * noise[:n]), -2.0, 2.0)
    else:
        u = noise[:n]
    return (u - u.mean()) / u.std()


def random_system(rng: np.random.Generator, order: int) -> StateSpace:
    """Modes that last 2 to 100 samples or so, and now and then a feedthrough."""
    n_inputs, n_outputs = [(1, 1), (1, 1), (2, 2), (2, 1), (1, 2)][rng.integers(5)]
    A = np.zeros((order, order))
    k = 0
    while k < order:
        radius = 1.0 - 10.0 ** rng.uniform(-2.0, -0.3)
        angle = rng.uniform(0.05, 2.5)
        if k + 1 < order and rng.random() < 0.7:
            turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
            A[k : k + 2, k : k + 2] = radius * np.array(turn)
            k += 2
        else:
            A[k, k] = radius
            k += 1
    B, C = (
        rng.standard_normal((order, n_inputs)),
        rng.standard_normal((n_outputs, order)),
    )
    D = (rng.random() < 0.3) * rng.standard_normal((n_outputs, n_inputs))
    return StateSpace(A, B, C, D, 1.0)


def open_loop(
    rng: np.random.Generator, system: StateSpace, n: int, bent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Input and noisy output, of a nonlinear sensor or actuator where `bent`."""
    kind = rng.choice(INPUTS)
    u = np.column_stack([signal(rng, kind, n) for _ in range(system.n_inputs)])
    y = system.simulate(u)
    if bent:
        size, how = y.std(axis=0), rng.integers(3)
        if how == 0:
            y = y + 0.3 * y**3 / size**2
        elif how == 1:
            y = np.clip(y, -size, size)
        else:
            y = system.simulate(u + 0.5 * np.abs(u))
    white, colour = rng.standard_normal((n, system.n_outputs)), rng.integers(3)
    if colour == 1:
        white = lfilter([1.0], [1.0, -0.9], white, axis=0)
    elif colour == 2:
        drive = StateSpace(system.A, np.eye(system.order), system.C, None, 1.0)
        white = drive.simulate(rng.standard_normal((n, system.order))) + 0.3 * white
    level = 10.0 ** (-rng.choice([0.0, 10.0, 20.0, 40.0, 60.0]) / 20.0)
    return u, y + level * y.std(axis=0) / white.std(axis=0) * white


def false_alarms(n_fits: int, first: int) -> None:
    """Print how often fits of open-loop records warn."""
    told, spent = defaultdict(list), 0.0
    for run in range(first, first + n_fits):
        rng = np.random.default_rng([run, 7])
        given = ("right order", "automatic", "too low", "bent")[rng.integers(4)]
        order = int(rng.integers(1 + 2 * (given == "too low"), 9))
        n = int(10.0 ** rng.uniform(2.3, 4.3))
        u, y = open_loop(rng, random_system(rng, order), n, given == "bent")
        wanted = {"automatic": "auto", "too low": order - 2}.get(given, order)
        begin = time.process_time()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                SubspaceLTI(wanted).fit(u, y)
            except ValueError:
                continue  # too few samples for the order
        spent += time.process_time() - begin
        text = " ".join(str(w.message) for w in caught)
        told[given].append(("closed loop" in text, "depends on past" in text, run))
    print(f"\nopen loop, {spent:.0f} s  fits  feedback [%]  lack [%]")
    for given, rows in told.items():
        feedback, lack, run = np.array(rows).T
        print(
            f"{given:20s}{len(rows):6d}{100 * feedback.mean():14.2f}"
            f"{100 * lack.mean():10.2f}   lack in {run[lack > 0].tolist()}"
        )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--fits", type=int, default=300)
    options = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        accuracy(range(options.first, options.first + options.runs))
    false_alarms(options.fits, options.first)


if __name__ == "__main__":
    main()
