"""Excitation signals and noisy tables of identification experiments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator, RandomState
from numpy.typing import NDArray
from sklearn.utils import check_random_state

from ..validation import (
    naming_argument,
    number,
    positive_time,
    real_array,
    shown,
    whole_number,
)

Array = NDArray[np.float64]

MOST_BITS = 10**6  # of a window that is balanced: all of one are held at once

_MOST_STEPS = 2_000  # of integration in a sampling period: 1 s of the arm

_LOUDEST = 1000  # decibels of noise above its signal: its squares are numbers still

_MOST_ROWS = 1e7  # of a built-in data set: more take minutes and the memory

_MOST = 1e8  # samples, experiments or bits of a built-in data set: more is a mistake


def prbs(
    n_samples: int,
    n_channels: int = 1,
    *,
    amplitude: float = 1.0,
    clock: int = 1,
    balance: int | None = None,
    random_state: int | RandomState | Generator | None = None,
) -> Array:
    """Pseudo-random binary sequences, independent between channels.

    Parameters
    ----------
    n_samples : int
        Length of the sequences.
    n_channels : int, default=1
        Number of sequences.
    amplitude : float, default=1.0
        The two levels are ``+amplitude`` and ``-amplitude``.
    clock : int, default=1
        Samples for which each bit is held. The spectrum of independent bits is flat
        up to about ``2.8 / clock`` rad/sample (half the power) and zero at
        ``2 pi / clock``.
    balance : int, default=None
        If given (even), every window of that many bits holds as many bits of one
        level as of the other, so that the integral of the sequence returns to zero at
        the end of each window: frequencies below ``2 pi / (balance * clock)`` are
        hardly excited and an integrating system does not drift.
        None draws independent bits.
    random_state : int, RandomState, Generator or None, default=None
        Seed of the sequences.

    Returns
    -------
    u : ndarray of shape (n_samples, n_channels)

    Raises
    ------
    ValueError
        If a number is out of its range.

    Examples
    --------
    >>> from lpvlearn.datasets import prbs
    >>> prbs(8, clock=2, balance=2, random_state=0).ravel().tolist()
    [1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0]
    """
    n_samples, n_channels = (
        check_count("n_samples", n_samples),
        check_count("n_channels", n_channels),
    )
    clock, amplitude = check_count("clock", clock), check_size("amplitude", amplitude)
    lengths = {"n_samples": n_samples}
    if balance is not None:
        balance = whole_number("balance", balance, 2, MOST_BITS)
        if balance % 2:
            raise ValueError(f"`balance` must be even, or None. Got {balance}.")
        lengths["balance"] = balance  # whose windows are drawn whole
    for name, length in lengths.items():
        if length * n_channels > _MOST:
            raise ValueError(
                f"`{name}` times `n_channels` must be at most {_MOST:g}. Got "
                f"{float(length) * n_channels:.4g}."
            )
    rng = (
        random_state
        if isinstance(random_state, Generator)
        else spawn_generators(random_state, 1)[0]
    )
    n_bits = -(-n_samples // clock)
    if balance is None:
        bits = rng.integers(0, 2, size=(n_channels, n_bits)) * 2.0 - 1.0
    else:
        windows = np.ones((n_channels, -(-n_bits // balance), balance))
        windows[..., balance // 2 :] = -1.0
        bits = rng.permuted(windows, axis=-1).reshape(n_channels, -1)
    held = np.repeat(bits[:, :n_bits], min(clock, n_samples), axis=1)
    return amplitude * held[:, :n_samples].T


def experiment_tables(
    inputs: dict[str, Array],
    y: Array,
    outputs: list[str],
    dt: float,
    snr_db: float,
    n_repeats: int,
    rng: Generator,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Experiments (n_experiments, n_samples, ...), each repeated with new white noise.

    For each output and experiment ``10 log10(cov(y_k) / cov(v_k)) = snr_db``, footnote
    5 of the paper; infinity is no noise.
    """
    n_experiments, n_samples, n_outputs = y.shape
    scale = y.std(axis=1, keepdims=True) * 10.0 ** (-snr_db / 20.0)
    draws = rng.standard_normal((n_experiments, n_repeats, n_samples, n_outputs))
    noisy = (y[:, np.newaxis] + scale[:, np.newaxis] * draws).reshape(-1, n_outputs)
    table = {k: np.repeat(v, n_repeats, axis=0).ravel() for k, v in inputs.items()}
    n_labels = n_experiments * n_repeats
    table["experiment"] = np.repeat(np.arange(n_labels), n_samples)
    table["time"] = np.tile(np.arange(n_samples) * dt, n_labels)
    return pd.DataFrame(table, copy=False), pd.DataFrame(noisy, columns=outputs)


def spawn_generators(
    random_state: int | RandomState | None, n_generators: int
) -> list[Generator]:
    """Independent generators, so that one draw never shifts another one."""
    with naming_argument(
        "random_state", "be a whole number from 0 to 2**32 - 1, or None", random_state
    ):
        rng = check_random_state(random_state)
    seeds = rng.randint(2**31 - 1, size=n_generators)
    return [np.random.default_rng(seed) for seed in seeds]


def samples_of(name: str, duration: float, dt: float) -> int:
    """Number of samples in a duration, of a sampling time that was checked."""
    rule = f"finite and at least `sampling_time` ({dt} s)"
    return check_count(name, float(np.rint(number(name, duration, rule, low=dt) / dt)))


def check_count(name: str, value: Any) -> int:
    """`value` as a whole number of at least 1 that memory may hold."""
    whole = number(name, value, "an integer of at least 1", low=1.0)
    if whole != np.rint(whole) or whole > _MOST:
        raise ValueError(
            f"`{name}` must be an integer of at least 1, at most {_MOST:g}. Got "
            f"{shown(value)}."
        )
    return int(whole)


def check_rows(**counts: int) -> None:
    """Refuse a data set whose counts, multiplied, are more rows than one may hold."""
    rows = math.prod(counts.values())
    if rows > _MOST_ROWS:
        names = " times ".join(f"`{name}`" for name in counts)
        raise ValueError(
            f"{names} must be at most {_MOST_ROWS:g} rows. Got {rows:.4g}; make "
            "several data sets of other seeds."
        )


def check_size(name: str, value: Any, may_be_zero: bool = False) -> float:
    """`value` as a finite positive number (or zero, where that may be)."""
    if may_be_zero:
        return number(name, value, "finite and non-negative", low=0.0)
    return number(name, value, "finite and positive", above=0.0)


def decibels(name: str, value: Any) -> float:
    """`value` as a ratio in decibels, which may be infinite."""
    ratio = real_array(name, value)
    if ratio.ndim or not ratio >= -_LOUDEST:
        raise ValueError(
            f"`{name}` must be a number of decibels, at least {-_LOUDEST:g}, or "
            f"infinity. Got {shown(value)}."
        )
    return float(ratio)


def steps_of(sampling_time: Any, integration_step: Any, longest: float = np.inf) -> int:
    """Equal steps of a sampling period, each at most that and the `longest`."""
    dt = positive_time("sampling_time", sampling_time)
    step = min(check_size("integration_step", integration_step), longest)
    if dt > _MOST_STEPS * step:
        raise ValueError(
            f"`sampling_time` must be at most {_MOST_STEPS} integration steps of "
            f"{step:.3g} s. Got {dt} s."
        )
    # A quotient that is a hair above a whole number is that number.
    return max(1, int(np.ceil(dt / step - 1e-9)))
