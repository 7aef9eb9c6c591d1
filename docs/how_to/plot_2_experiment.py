r"""
.. _how_to_experiment:

Design the experiment
=====================

How fast to sample, what to excite with, how long, how large, and at which points: a
formula for each, then the whole plan tried on a model before anybody goes to the plant.
You need rough guesses only: of the slowest and the fastest motion that matter, of the
noise, and of what is small.
"""

# %%
# Formulas
# --------
# Let :math:`\omega_1` and :math:`\omega_n` be the slowest and the fastest pole that
# matter in rad/s, :math:`\zeta` the damping of the lightest mode.
#
# .. list-table::
#    :header-rows: 1
#    :widths: 20 40 40
#
#    * - Choice
#      - Formula
#      - Why
#    * - sampling time
#      - :math:`T_s = \dfrac{2\pi}{20\, \omega_n}`
#      - Twenty samples in a period of the fastest motion. Ten is the least. Much faster
#        costs: poles crowd at 1, and horizons must grow.
#    * - hold of a bit
#      - :math:`c \le \dfrac{2.8}{\omega_n T_s}` samples
#      - A random binary sequence is flat up to :math:`2.8 / (c\, T_s)`. Longer holds
#        put power where it is lower.
#    * - length
#      - :math:`T \ge \dfrac{10}{\zeta\,\omega}` of the mode that decays most slowly
#      - Ten time constants; less, and the start of the record is most of it.
#    * - more of it
#      - :math:`\sigma \propto \dfrac{1}{a \sqrt{T}}`
#      - Standard deviations fall with the amplitude and with the root of the length. So
#        double amplitude is worth four times the time.
#    * - amplitude
#      - where the error by noise, :math:`\propto 1/a`, meets that by non-linearity,
#        :math:`\propto a^2` of an odd one
#      - Repeat one record at half the amplitude: gains that change by more than their
#        standard deviations are non-linear.
#    * - bits of the converter
#      - :math:`6.02\, b + 1.76` dB below full scale
#      - Use the range: a signal of 1 % of it loses 40 dB. 40 dB above all
#        noise is good, 20 dB will do for a longer record.
#    * - number of points
#      - degree + 1, and two more
#      - Two more tell whether the degree is right.
#    * - their places
#      - :math:`\kappa_i = m + h \cos\dfrac{(2i - 1)\,\pi}{2p}`
#      - Chebyshev's: denser at the ends, where polynomials overshoot. Evenly spaced
#        does as well up to five points. Let the range of points hold all values at
#        which the model is used.
#
# As code, for a spring that goes from 4 to 9 rad/s with a damping of 0.05:

import numpy as np
import pandas as pd

slowest, fastest, damping = 4.0, 9.0, 0.05
ideal = 2 * np.pi / (20 * fastest)
step = 0.03  # a round number nearby
hold = int(2.8 / (fastest * step))
length = 10 / (damping * slowest)
points = 1.0 + 1.0 * np.cos((2 * np.arange(5, 0, -1) - 1) * np.pi / 10)
print(f"sampling time {ideal:.3f} s: take {step} s; hold bits for {hold} samples")
print(f"at least {length:.0f} s at each point, {length / step:.0f} samples")
print("points in [0, 2]:", points.round(2))

# %%
# What is excited: the power of the input at the frequencies of the modes, relative to
# that at zero. A factor of ten less means deviations about three times as large.

from lpvlearn.datasets import prbs

held = 0.5 * hold * step * np.array([slowest, fastest])
pd.Series((np.sin(held) / held) ** 2, ["slowest", "fastest"]).round(2)

# %%
# The plan, tried
# ---------------
# The best formula is the experiment itself, on the computer: a structure with guessed
# numbers, the planned input, the noise of the sensor. The pipeline tells the standard
# deviations that the real experiment will have.

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    SubspaceLTI,
    from_trajectories,
)

spring = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
)
NOISE = 0.02  # of the position, in its own unit


def plan(points, length, amplitude, structure=spring, seed=0):
    """The pipeline after a simulated experiment."""
    rng = np.random.default_rng(seed)
    runs = []
    for k, kappa in enumerate(points):
        guess = {"k": 16.0 + 32.5 * kappa, "c": 0.1 * np.sqrt(16 + 32.5 * kappa)}
        u = prbs(int(length / step), clock=hold, amplitude=amplitude, random_state=k)
        y = spring.model(guess | {"b": 10.0}).simulate(u, sampling_time=step)
        runs.append((u, kappa, y + NOISE * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=step)
    return LocalLPVPipeline(
        SubspaceLTI(2, feedthrough=False),
        GrayBoxRestructurer(structure),
        scheduling="kappa",
        experiment="experiment",
        time="time",
    ).fit(X, y)


first = plan(points, length, amplitude=1.0)
plans = {
    "as planned": first,
    "four times as long": plan(points, 4 * length, amplitude=1.0),
    "twice the amplitude": plan(points, length, amplitude=2.0),
}
deviation = {
    name: (fit.parameters_std_ / fit.parameters_.abs()).mean()
    for name, fit in plans.items()
}
pd.DataFrame(deviation).map("{:.2%}".format)

# %%
# As the formula says: both halve the deviations. Choose the cheaper one.
#
# Where next
# ----------
# After the first points, the model itself tells where the next one is worth most: where
# its uncertainty is largest between them (:func:`~lpvlearn.suggest_operating_point`).

from lpvlearn import suggest_operating_point

three = plan(points[[0, 2, 4]], length, amplitude=1.0)
suggest_operating_point(three)
