"""The automatic choice beside a full scan of horizons, on the flexible arm.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/scan_horizons.py``. At every
operating point and for every seed the best fit on a new noise-free experiment is
compared between ``horizon="auto"`` (order given, and order automatic as well) and the
best horizon of a scan, for PO-MOESP and PI-MOESP, with two excitations.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np

from lpvlearn import SubspaceLTI
from lpvlearn.datasets import make_flexible_arm

ARMS = {
    "default": {},
    "5 ms bits": {"clock": 0.005, "balance_time": None},
}
HORIZONS = (20, 30, 40, 55, 75, 95, 125)


def fit_percent(model: SubspaceLTI, u: np.ndarray, y: np.ndarray) -> float:
    """BFT on a new experiment from rest, the mean over outputs."""
    error = np.linalg.norm(y - model.predict(u), axis=0)
    spread = np.linalg.norm(y - y.mean(axis=0), axis=0)
    return float(np.maximum(100.0 * (1.0 - error / spread), 0.0).mean())


def scan(arm: str, method: str, n_seeds: int, n_points: int, refine: bool) -> None:
    losses, order_losses, orders, chosen, times, failed = [], [], [], [], [], 0
    bests, warned = [], 0
    for seed in range(n_seeds):
        data = make_flexible_arm(n_points, random_state=seed, **ARMS[arm])
        for point in range(n_points):
            rows = (data.X["experiment"] == point).to_numpy()
            u, y = data.X[rows][["u1", "u2"]].to_numpy(), data.y[rows].to_numpy()
            new = (data.X_local["experiment"] == point).to_numpy()
            v = data.X_local[new][["u1", "u2"]].to_numpy()
            z = data.y_local[new].to_numpy()
            options = {"method": method, "refine": refine, "sampling_time": 1e-3}

            scores = []
            for horizon in HORIZONS:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    model = SubspaceLTI(6, horizon=horizon, **options).fit(u, y)
                scores.append(fit_percent(model, v, z))
                poor = scores[-1] < 90.0
                failed += poor
                warned += poor and bool(caught)
            best = max(scores)
            start = time.process_time()
            model = SubspaceLTI(6, **options).fit(u, y)
            times.append(time.process_time() - start)
            chosen.append(model.horizon_)
            losses.append(best - fit_percent(model, v, z))
            model = SubspaceLTI(**options).fit(u, y)
            orders.append(model.order_)
            order_losses.append(best - fit_percent(model, v, z))
            bests.append(best)
    share = 100.0 * np.mean(np.array(losses) <= 0.3)
    counts = dict(zip(*np.unique(orders, return_counts=True), strict=True))
    print(
        f"{arm}, {method}, refine={refine}: best of scan {np.median(bests):.2f} %; "
        f"auto horizon loses {np.median(losses):.2f} median, {max(losses):.2f} worst "
        f"({share:.0f} % within 0.3); chosen {min(chosen)} to {max(chosen)} (median "
        f"{np.median(chosen):.0f}), {1e3 * np.median(times):.0f} ms. Auto order too: "
        f"{np.median(order_losses):.2f} median, {max(order_losses):.2f} worst; orders "
        f"{ {int(k): int(v) for k, v in counts.items()} }. Given horizons below 90 %: "
        f"{failed}, of which {warned} warned.",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--points", type=int, default=7)
    parser.add_argument("--unrefined", action="store_true")
    options = parser.parse_args()
    for arm in ARMS:
        for method in ("po-moesp", "pi-moesp"):
            scan(arm, method, options.seeds, options.points, not options.unrefined)


if __name__ == "__main__":
    main()
