"""Subspace identification beside its peers: accuracy, time, size of data.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_subspace.py``. The
peers ``ctrlsys`` (SLICOT IB01), ``sippy-unipi``, ``nfoursid``, ``llsi`` and ``mdof``
are compared where they are installed. Nothing here is asserted: times belong to a
machine. They are processor times, so that other load does not count.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from collections.abc import Callable
from unittest import mock

import numpy as np
from scipy.linalg import block_diag, expm

from lpvlearn.subspace.orders import identification
from lpvlearn.subspace.orders.selection import select
from lpvlearn.subspace.samples.hankel import _hankel_matrix, data_factors
from lpvlearn.subspace.samples.records import scale_records
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom
from lpvlearn.systems.simulation import lti_response

try:
    import ctrlsys
except ImportError:
    ctrlsys = None
try:
    import sippy_unipi
except ImportError:
    sippy_unipi = None
try:
    import pandas
    from nfoursid.nfoursid import NFourSID
except ImportError:
    NFourSID = None
try:
    import llsi
except ImportError:
    llsi = None
try:
    from mdof import realize as mdof_realize
except ImportError:
    mdof_realize = None

Array = np.ndarray
System = tuple[Array, Array, Array, Array]


def resonant_system(rng: np.random.Generator, order: int, n_channels: int) -> System:
    """Lightly damped modes (damping 0.01 to 0.02) with feedthrough."""
    blocks = []
    for w, z in zip(
        rng.uniform(0.1, 2.5, order // 2),
        rng.uniform(0.01, 0.02, order // 2),
        strict=True,
    ):
        c, s = np.cos(w), np.sin(w)
        blocks.append(np.exp(-z * w) * np.array([[c, s], [-s, c]]))
    k = n_channels
    B, C = rng.standard_normal((order, k)), rng.standard_normal((k, order))
    return block_diag(*blocks), B, C, rng.standard_normal((k, k))


def arm_system() -> System:
    """A slow pole beside fast modes, sampled at 1 ms, as the flexible arm has."""
    blocks = [np.array([[-0.7]]), np.array([[-45.0]])]
    blocks += [np.array([[s, w], [-w, s]]) for s, w in ((-3.8, 52.6), (-46.0, 121.0))]
    B = np.array([[0.3, 0.2], [20, 12], [2, -3], [1, 2], [9, 6], [-8, 9]])
    C = np.array([[1, 0.6, 1, 0.5, 0.7, 0.4], [-0.8, 1, 0.7, -1, 0.5, -0.6]])
    M = expm(np.block([[block_diag(*blocks), B], [np.zeros((2, 8))]]) * 1e-3)
    return M[:6, :6], M[:6, 6:], C, np.zeros((2, 2))


def identify(u: Array, y: Array, order: int, horizon: int, **options) -> System:
    """The function core of `SubspaceLTI`."""
    records, su, sy = scale_records([(u, y)])
    settings = _settings(u, y, **options)
    model = identification.identify(records, order, horizon, settings).model
    return model.A, model.B / su, sy[:, None] * model.C, sy[:, None] * model.D / su


def _settings(u: Array, y: Array, **options) -> identification.Settings:
    free = Freedom(np.ones((y.shape[1], u.shape[1]), dtype=bool))
    return identification.Settings(free, **options)


def ours(method: str, refine: bool) -> Callable[..., System]:
    def fit(u: Array, y: Array, order: int, horizon: int) -> System:
        return identify(u, y, order, horizon, method=method, refine=refine)

    return fit


def slicot(u: Array, y: Array, order: int, horizon: int) -> System:
    """MOESP (A, C) and the simulation least squares of IB01CD."""
    m, p = u.shape[1], y.shape[1]
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    _, r, *_ = ctrlsys.ib01ad("M", "C", "N", "O", "N", "N", horizon, m, p, u, y, 0, -1)
    A, C, *_ = ctrlsys.ib01bd("M", "C", "N", horizon, order, m, p, len(u), r, 0.0)
    A, C = A[:order, :order], C[:, :order]
    zero = np.zeros((order, m), order="F"), np.zeros((p, m), order="F")
    V, B, D = _ib01cd(order, m, p, A, C, zero, u, y)
    return A, B, C, D


def _ib01cd(
    n: int, m: int, p: int, A: Array, C: Array, zero: tuple[Array, Array], u, y
) -> tuple[Array, Array, Array]:
    A, C = A.copy(order="F"), C.copy(order="F")
    _, B, D, V, *_ = ctrlsys.ib01cd(
        "X", "C", "D", n, m, p, A, zero[0], C, zero[1], u.copy("F"), y.copy("F"), 0.0
    )
    return V, B, D


def sippy(u: Array, y: Array, order: int, horizon: int) -> System:
    with contextlib.redirect_stdout(io.StringIO()):
        found = sippy_unipi.system_identification(
            y.T,
            u.T,
            "MOESP",
            SS_fixed_order=order,
            SS_f=horizon,
            SS_p=horizon,
            SS_D_required=True,
        )
    return found.A, found.B, found.C, found.D


def nfoursid(u: Array, y: Array, order: int, horizon: int) -> System:
    inputs = [f"u{i}" for i in range(u.shape[1])]
    outputs = [f"y{i}" for i in range(y.shape[1])]
    frame = pandas.DataFrame(np.hstack([u, y]), columns=inputs + outputs)
    fit = NFourSID(frame, outputs, inputs, num_block_rows=horizon)
    fit.subspace_identification()
    model, _ = fit.system_identification(rank=order)
    return model.a, model.b, model.c, model.d


def llsi_po_moesp(u: Array, y: Array, order: int, horizon: int) -> System:
    """PO-MOESP of llsi, which sets its horizon from the order: (2 n + 1) n_u."""
    inputs = {f"u{i}": column for i, column in enumerate(u.T)}
    outputs = {f"y{i}": column for i, column in enumerate(y.T)}
    data = llsi.SysIdData(Ts=1.0, **inputs, **outputs)
    model = llsi.sysid(data, list(outputs), list(inputs), order, method="po-moesp")
    return model.A, model.B, model.C, model.D


def mdof_n4sid(u: Array, y: Array, order: int, horizon: int) -> System:
    """N4SID of mdof. It takes no order (its own holds 99 % of the squared singular
    values), so the one search that counts them is made to answer ``order``."""
    n_columns = len(u) - 2 * horizon + 1
    with mock.patch("numpy.searchsorted", return_value=order - 1):
        return mdof_realize.n4sid(u.T, y.T, horizon, n_columns)[:4]


def contenders() -> dict[str, Callable[..., System]]:
    table: dict[str, Callable[..., System]] = {
        "lpvlearn po-moesp": ours("po-moesp", True),
        "lpvlearn po-moesp, unrefined": ours("po-moesp", False),
        "lpvlearn pi-moesp": ours("pi-moesp", True),
        "lpvlearn n4sid": ours("n4sid", True),
        "lpvlearn cva": ours("cva", True),
    }
    if ctrlsys is not None:
        table["ctrlsys MOESP + IB01CD"] = slicot
    if sippy_unipi is not None:
        table["sippy-unipi MOESP"] = sippy
    if NFourSID is not None:
        table["nfoursid"] = nfoursid
    if llsi is not None:
        table["llsi PO-MOESP, own horizon"] = llsi_po_moesp
    if mdof_realize is not None:
        table["mdof N4SID, order forced"] = mdof_n4sid
    return table


def accuracy(order: int, n_channels: int, n: int, horizon: int, n_seeds: int) -> None:
    print(f"\norder {order}, {n_channels} x {n_channels}, N = {n}, horizon {horizon}")
    for name, fit in contenders().items():
        scores, times = [], []
        for seed in range(n_seeds):
            rng = np.random.default_rng(seed)
            system = resonant_system(rng, order, n_channels)
            u, v = rng.standard_normal((2, n, n_channels))
            y, z = lti_response(*system, u), lti_response(*system, v)
            y = y + 10**-1.5 * y.std(axis=0) * rng.standard_normal(y.shape)
            start = time.process_time()
            model = fit(u, y, order, horizon)
            times.append(time.process_time() - start)
            error = np.linalg.norm(z - lti_response(*model, v), axis=0)
            spread = np.linalg.norm(z - z.mean(axis=0), axis=0)
            scores.append(100.0 * (1.0 - error / spread).mean())
        print(
            f"  {name:30s} median BFT {np.median(scores):6.2f} %   "
            f"{1e3 * np.median(times):7.1f} ms"
        )


def compression(n: int, horizon: int) -> None:
    z = np.random.default_rng(0).standard_normal((n, 4))
    start = time.process_time()
    next(data_factors([z], 2, [horizon]))
    fast = time.process_time() - start
    start = time.process_time()
    np.linalg.qr(_hankel_matrix(z, 2 * horizon).T, mode="r")
    plain = time.process_time() - start
    print(
        f"  N = {n}, horizon {horizon}: {1e3 * fast:.1f} ms, numpy QR of the "
        f"stacked matrix {1e3 * plain:.1f} ms, ratio {plain / fast:.1f}"
    )


def consistency() -> None:
    """Relative error of the frequency response at 10 dB as the record grows.

    The median over 20 systems, and the median of their falls per decade.
    """
    print("\nconsistency at 10 dB: relative error for N = 3k, 30k, 300k")
    omega = np.linspace(0.01, 3.1, 400)

    def response(model: System) -> Array:
        A, B, C, D = model
        z = np.exp(1j * omega)[:, None, None]
        return C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j * z) + D

    for noise in ("white", "AR(1) 0.9"):
        for method, refine, n_noise in (
            ("po-moesp", True, 0),
            ("pi-moesp", True, 0),
            ("po-moesp", False, 0),
            ("po-moesp", False, 2),
            ("po-moesp", True, 2),
            ("pi-moesp", False, 0),
        ):
            runs = []
            for n in (3_000, 30_000, 300_000):
                errors = []
                for seed in range(20):
                    rng = np.random.default_rng(seed)
                    system = resonant_system(rng, 6, 2)
                    u = rng.standard_normal((n, 2))
                    y = lti_response(*system, u)
                    e = rng.standard_normal(y.shape)
                    if noise != "white":
                        pole = 0.9 * np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))
                        e = lti_response(*pole, e)
                    y = y + 10**-0.5 * y.std(axis=0) * e / e.std(axis=0)
                    model = identify(
                        u,
                        y,
                        6,
                        20 if method == "po-moesp" else 40,
                        method=method,
                        refine=refine,
                        n_noise_states=n_noise,
                    )
                    truth = response(system)
                    gap = np.linalg.norm(response(model) - truth)
                    errors.append(gap / np.linalg.norm(truth))
                runs.append(errors)
            figures = "  ".join(f"{value:.4f}" for value in np.median(runs, axis=1))
            falls = np.array(runs[:-1]) / np.array(runs[1:]) / np.sqrt(10.0)
            by_root_n = np.median(falls, axis=1)
            print(
                f"  {noise:10s} {method} refine={refine!s:5} noise states {n_noise}  "
                f"{figures}  fall per decade by sqrt(10): {by_root_n.round(2)}"
            )


def monte_carlo(n_fits: int) -> None:
    """The arm's Monte Carlo: the automatic horizon reused by all realizations."""
    system = arm_system()
    rng = np.random.default_rng(0)
    u = 0.1 * np.repeat(rng.choice([-1.0, 1.0], (600, 2)), 5, axis=0)
    clean = lti_response(*system, u)
    sigma = clean.std(axis=0) * 10**-1.5
    for method in ("po-moesp", "pi-moesp"):
        y = clean + sigma * rng.standard_normal(clean.shape)
        start = time.process_time()
        records = scale_records([(u, y)]).records
        settings = _settings(u, y, method=method)
        horizon = select(records, 6, None, settings).horizon
        chosen = time.process_time() - start
        start = time.process_time()
        for _ in range(n_fits):
            y = clean + sigma * rng.standard_normal(clean.shape)
            identify(u, y, 6, horizon, method=method)
        total = time.process_time() - start
        print(
            f"  {method}: horizon {horizon} chosen in {chosen:.2f} s, then "
            f"{1e3 * total / n_fits:.1f} ms a fit"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--fits", type=int, default=50)
    parser.add_argument("--large", action="store_true", help="N = 10^6, consistency")
    options = parser.parse_args()
    for horizon in (15, 30):
        accuracy(6, 2, 3000, horizon, options.seeds)
    accuracy(12, 4, 10_000, 20, max(3, options.seeds // 4))
    print("\ncompression of 2 x 2 data")
    for n, horizon in ((3000, 30), (3000, 80), (100_000, 30)):
        compression(n, horizon)
    print("\nMonte Carlo of the arm")
    monte_carlo(options.fits)
    if options.large:
        compression(1_000_000, 30)
        consistency()


if __name__ == "__main__":
    main()
