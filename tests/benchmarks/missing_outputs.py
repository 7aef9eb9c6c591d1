"""Records of which outputs are missing at random: estimated, cut, and complete.

    python tests/benchmarks/missing_outputs.py [--records 10] [--first 0]

Random systems of order 4, one input, two outputs, 1,500 samples, noise of a tenth of
the outputs, white and AR(0.9); order and horizon are found. The error is that of the
frequency response, relative, by that of the complete record (median, worst); bands are
95 % bands of the response that hold the truth.
"""

import argparse
import time
import warnings

import numpy as np
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI

OMEGA = np.linspace(0.01, 3.1, 100)


def record(seed, colour):
    """System, inputs, outputs."""
    rng = np.random.default_rng(seed)
    A = np.zeros((4, 4))
    for k in (0, 2):
        radius, angle = rng.uniform(0.6, 0.97), rng.uniform(0.1, 2.5)
        turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        A[k : k + 2, k : k + 2] = radius * np.array(turn)
    B, C = rng.standard_normal((4, 1)), rng.standard_normal((2, 4))
    true = StateSpace(A, B, C, None, 1.0)
    u = rng.standard_normal((1500, 1))
    y = true.simulate(u)
    e = rng.standard_normal(y.shape)
    e = lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], e, axis=0)
    return true, u, y + 0.1 * y.std(axis=0) * e


def fitted(true, u, y, missing):
    """Error, order, share of the bands that hold, CPU seconds."""
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = SubspaceLTI(missing=missing, sampling_time=1.0).fit(u, y)
    seconds = time.process_time() - start
    wrong = model.lti_.frequency_response(OMEGA) - true.frequency_response(OMEGA)
    error = np.linalg.norm(wrong) / np.linalg.norm(true.frequency_response(OMEGA))
    std = model.frequency_response_std(OMEGA)
    inside = np.abs(wrong.real) <= 1.96 * std.real
    return error, model.order_, np.mean(inside), seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.records)
    print("noise  missing  by         error  worst  order 4   bands   CPU s")
    for colour in (0.0, 0.9):
        records = [record(seed, colour) for seed in seeds]
        whole = np.array([fitted(*r, "raise") for r in records])
        for share in (0.0, 0.05, 0.1, 0.3, 0.5):
            rows = {"complete": whole} if share == 0.0 else {}
            ways = ("estimate", "split")[: (share > 0.0) + (share == 0.05)]
            for way in ways:
                found = []
                for seed, (true, u, y) in zip(seeds, records, strict=True):
                    lost = np.random.default_rng(seed).random(y.shape) < share
                    found.append(fitted(true, u, np.where(lost, np.nan, y), way))
                rows[way] = np.array(found)
            for way, found in rows.items():
                ratio = found[:, 0] / whole[:, 0]
                right = np.count_nonzero(found[:, 1] == 4)
                print(
                    f"{'AR(.9)' if colour else 'white':6} {100 * share:6.0f} %  {way:9}"
                    f"{np.median(ratio):7.2f} {ratio.max():6.2f}"
                    f" {right:4}/{len(ratio):<3}{100 * found[:, 2].mean():7.1f} %"
                    f" {np.median(found[:, 3]):6.1f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
