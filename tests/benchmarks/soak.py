"""A soak test: many fits in one process, whose memory and open files stay as they are.

    python tests/benchmarks/soak.py [n_fits]

Every tenth of the run it tells the resident memory and the open files; at the end, how
far memory went from where it stood after the first tenth, which must be less than 5 %.
"""

import gc
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_scorer,
    load,
    save,
)
from lpvlearn.inspection import PoleDisplay
from tests.conftest import ROLES, spring_structure, spring_tables

FLAT = 0.05  # of the memory after the first tenth
EVERY = 50  # fits between two pictures


def resident():
    """Resident memory in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def one_fit(number, folder):
    """Every kind in turn: a local model, a chain without and with a structure."""
    X, y = spring_tables(
        noise=0.01, n_samples=60, kappas=(0.0, 0.7, 1.5), seed=number % 97
    )
    local = SubspaceLTI(2, method="po-moesp", horizon=5, refine=False, offset=None)
    if number % 3 == 0:
        model = local.set_params(
            inputs="force", experiment="run", time="time", sampling_time=0.02
        ).fit(X, y)
    else:
        gray_box = GrayBoxRestructurer(spring_structure(), norm="h2", n_starts=2)
        step = gray_box if number % 3 == 1 and number % 10 == 1 else "passthrough"
        model = LocalLPVPipeline(local, step, PolynomialLPV(1), **ROLES).fit(X, y)
    bft_scorer(model, X, y)
    save(model, folder / "model.zip")
    load(folder / "model.zip").predict(X)
    if number % EVERY == 1 and hasattr(model, "lpv_"):
        PoleDisplay.from_estimator(model)
        plt.close("all")


def soak(n_fits):
    seen, start = [], time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(n_fits):
            one_fit(number, Path(folder))
            if (number + 1) % max(1, n_fits // 10) == 0:
                gc.collect()
                seen.append((resident(), len(os.listdir("/proc/self/fd"))))
                print(
                    f"{number + 1:6d} fits  {seen[-1][0]:7.1f} MB  {seen[-1][1]} files "
                    f"{time.process_time() - start:6.0f} s of CPU",
                    flush=True,
                )
    memory, files = np.array(seen).T
    drift = np.abs(memory / memory[0] - 1.0).max()
    print(f"memory within {100 * drift:.1f} % of {memory[0]:.1f} MB")
    return drift < FLAT and (files == files[0]).all()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(not soak(int(sys.argv[1]) if len(sys.argv) > 1 else 1000))
