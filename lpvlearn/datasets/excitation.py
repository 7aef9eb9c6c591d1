"""Excitation signals and measurement noise of identification experiments."""

from __future__ import annotations

from numbers import Real

import numpy as np
from numpy.random import Generator, RandomState
from numpy.typing import NDArray
from sklearn.utils import check_random_state

Array = NDArray[np.float64]


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
    check_count("n_samples", n_samples)
    check_count("n_channels", n_channels)
    check_count("clock", clock)
    check_size("amplitude", amplitude)
    if balance is not None and (balance < 2 or balance % 2):
        raise ValueError(
            "`balance` must be None or an even number of bits, at least 2. "
            f"Got {balance}."
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
    return amplitude * np.repeat(bits, clock, axis=1)[:, :n_samples].T


def measurement_noise(
    y: Array, snr_db: float, n_realizations: int, rng: Generator
) -> Array:
    """White noise (..., n_realizations, n_samples, n_outputs) for noise-free outputs.

    For each output and experiment ``10 log10(cov(y_k) / cov(v_k)) = snr_db``, footnote
    5 of the paper; infinity is no noise.
    """
    scale = y.std(axis=-2, keepdims=True) * 10.0 ** (-snr_db / 20.0)
    shape = (*y.shape[:-2], n_realizations, *y.shape[-2:])
    return scale[..., np.newaxis, :, :] * rng.standard_normal(shape)


def spawn_generators(
    random_state: int | RandomState | None, n_generators: int
) -> list[Generator]:
    """Independent generators, so that one draw never shifts another one."""
    seeds = check_random_state(random_state).randint(2**31 - 1, size=n_generators)
    return [np.random.default_rng(seed) for seed in seeds]


def samples_of(name: str, duration: float, sampling_time: float) -> int:
    """Number of samples in a duration."""
    check_size("sampling_time", sampling_time)
    if not (np.isfinite(duration) and duration >= sampling_time):
        raise ValueError(
            f"`{name}` must be finite and at least `sampling_time` "
            f"({sampling_time} s). Got {duration}."
        )
    return round(duration / sampling_time)


def check_count(name: str, value: float) -> None:
    """Refuse what is no whole number of at least 1."""
    whole = isinstance(value, Real) and value == np.rint(value)
    if not whole or value < 1 or not np.isfinite(value):
        raise ValueError(f"`{name}` must be an integer of at least 1. Got {value!r}.")


def check_size(name: str, value: float, may_be_zero: bool = False) -> None:
    """Refuse what is not finite and positive (or zero, where that may be)."""
    finite = isinstance(value, Real) and np.isfinite(value)
    if not finite or not (value > 0 or (may_be_zero and value == 0)):
        rule = "non-negative" if may_be_zero else "positive"
        raise ValueError(f"`{name}` must be finite and {rule}. Got {value!r}.")
