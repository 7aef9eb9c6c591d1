"""Minimax problems whose solutions are known."""

from dataclasses import replace

import numpy as np

from lpvlearn.minimax.problem import MinimaxProblem, Peaks


def problem_of(functions, gradients, hessians, constraint=None):
    """A minimax problem of smooth functions; the 'frequency' is their index."""

    def peaks(y):
        values = np.array([f(y) for f in functions])
        G = np.array([g(y) for g in gradients])
        index = np.arange(1.0, len(values) + 1)
        return Peaks(values, index, G, np.ones(len(values), bool))

    def samples(y, frequencies):
        chosen = np.asarray(frequencies, int) - 1
        full = peaks(y)
        return Peaks(
            full.values[chosen],
            full.frequencies[chosen],
            full.gradients[chosen],
            np.zeros(len(chosen), bool),
        )

    def at(y, frequencies):
        return samples(y, frequencies).values

    def second(y, weights, frequencies, moving):
        parts = [hessians[int(k) - 1](y) for k in frequencies]
        return np.tensordot(weights, parts, axes=1)

    def constraints(y):
        if constraint is None:
            return np.zeros(0), np.zeros((0, len(y)))
        c, dc = constraint(y)
        return np.array([c]), np.array([dc])

    return MinimaxProblem(peaks, samples, at, second, constraints)


def charalambous_bandler():
    """The CB2 problem; minimum 1.9522244 at (1.1390, 0.8996)."""

    def f3(y):
        return 2 * np.exp(y[1] - y[0])

    return problem_of(
        [
            lambda y: y[0] ** 2 + y[1] ** 4,
            lambda y: (2 - y[0]) ** 2 + (2 - y[1]) ** 2,
            f3,
        ],
        [
            lambda y: np.array([2 * y[0], 4 * y[1] ** 3]),
            lambda y: np.array([-2 * (2 - y[0]), -2 * (2 - y[1])]),
            lambda y: f3(y) * np.array([-1.0, 1.0]),
        ],
        [
            lambda y: np.diag([2.0, 12 * y[1] ** 2]),
            lambda y: 2 * np.eye(2),
            lambda y: f3(y) * np.array([[1.0, -1.0], [-1.0, 1.0]]),
        ],
    )


def with_narrow_peaks(problem, sharpness):
    """The same maxima as peaks over a frequency, along which they move with y.

    ``phi_i(y, w) = phi_i(y) - sharpness (w - w_i(y))^2``.
    """
    turn = np.array([0.3, -0.2])

    def places(y):
        return 100.0 + 10.0 * np.arange(3) + turn @ y

    def nearest(y, w):
        k = np.abs(w[:, None] - places(y)).argmin(1)
        return k, w - places(y)[k]

    def peaks(y):
        return replace(problem.peaks(y), frequencies=places(y))

    def samples(y, w):
        (k, off), found = nearest(y, w), problem.peaks(y)
        return Peaks(
            found.values[k] - sharpness * off**2,
            w,
            found.gradients[k] + 2.0 * sharpness * off[:, None] * turn,
            np.zeros(len(w), bool),
        )

    def hessian(y, weights, w, moving):
        H = problem.hessian(y, weights, nearest(y, w)[0] + 1.0, moving)
        return H - 2.0 * sharpness * weights[~moving].sum() * np.outer(turn, turn)

    return replace(
        problem,
        peaks=peaks,
        samples=samples,
        values=lambda y, w: samples(y, w).values,
        hessian=hessian,
    )
