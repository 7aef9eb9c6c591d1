"""
From measured frequency responses
=================================

Vibration tests often end in frequency responses, not in time series. Step 4 of the
method works on those, too: :class:`~lpvlearn.GrayBoxRestructurer` is a regressor whose
samples are *frequencies*.
"""

# %%
# A clamped beam with a sliding mass, measured at five positions of the mass: force in,
# displacement out, 150 frequencies each, two resonances, with complex noise of 0.1 % of
# the highest peak.

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, LPVStateSpace, PolynomialLPV

modal = GrayBoxStructure.from_template(
    A=[[0, 1, 0, 0], ["-k1", "-c1", 0, 0], [0, 0, 0, 1], [0, 0, "-k2", "-c2"]],
    B=[[0], ["b1"], [0], ["b2"]],
    C=[[1, 0, 1, 0]],
)


def true_parameters(position):
    return {
        "k1": 40.0 - 12.0 * position**2,
        "c1": 0.5,
        "b1": 1.0 + 0.3 * position,
        "k2": 900.0 - 250.0 * position,
        "c2": 1.5,
        "b2": 6.0 - 3.0 * position,
    }


rng = np.random.default_rng(0)
omega = np.geomspace(1.0, 100.0, 150)
positions = np.linspace(0, 1, 5)
measured = []
for position in positions:
    G = modal.model(true_parameters(position)).frequency_response(omega)
    noise = rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape)
    measured.append(G + 0.001 * np.abs(G).max() * noise / np.sqrt(2))

# %%
# One fit per position. A complex array of shape (n_freq, n_outputs, n_inputs) is
# accepted as it is; its form as scikit-learn's ``y`` is ``[Re G, Im G]``. What is
# minimised is the largest error over the frequencies, so that a single bad line of the
# spectrum counts: leave it out, or give it a small ``sample_weight``.
#
# Modes have no numbers of their own: either half of this structure may become either
# resonance. So only the first fit starts from nothing, and every further one at
# the parameters of its neighbour. (A pipeline does that by itself.)

fits = [GrayBoxRestructurer(modal).fit(omega, measured[0])]
for G in measured[1:]:
    neighbour = fits[-1].params_
    fits.append(GrayBoxRestructurer(modal, init=neighbour).fit(omega, G))
found = pd.DataFrame(
    [fit.params_ for fit in fits],
    index=pd.Index(positions, name="position"),
    columns=list(modal.parameter_names),
)
found.round(3)

# %%
# Where the noise is known (``noise``, a standard deviation, or a ``coherence`` with its
# number of averages), errors count in standard deviations, and the covariance of the
# parameters is told. ``norm="covariance"`` minimises their squares instead of the
# largest one: the efficient parameters, whose `p_value_` doubts a wrong structure.

std = np.full(len(omega), 0.001 * np.abs(measured[0]).max())
efficient = GrayBoxRestructurer(modal, norm="covariance", init=fits[0].params_)
efficient.fit(omega, measured[0], noise=std)
print(f"p-value {efficient.p_value_:.2f}")
efficient.confidence_intervals().assign(truth=true_parameters(0.0)).round(3)

# %%
# The truth:

pd.DataFrame(map(true_parameters, positions), index=found.index)[found.columns].round(3)

# %%
# Measured and fitted response at the middle position:

from lpvlearn.inspection import BodeDisplay, ParameterDisplay

display = BodeDisplay(
    omega, {"measured": measured[2], "fitted": fits[2].lti_.frequency_response(omega)}
).plot(phase=True)

# %%
# It is a regressor: ``predict`` gives the response at other frequencies, ``score`` the
# usual :math:`R^2`, with ``y`` as real columns:

flat = measured[2].reshape(len(omega), -1)
print(f"R2 = {fits[2].score(omega, np.hstack([flat.real, flat.imag])):.5f}")
print(f"relative error = {fits[2].relative_error_:.4f}")

# %%
# Steps 5 and on are as always: interpolate, and use the model in the time domain.

interpolator = PolynomialLPV(degree=2).fit(positions[:, None], found)
beam = LPVStateSpace(modal, interpolator, [[0.0], [1.0]])
display = ParameterDisplay.from_parameters(
    positions, {"fitted": found}, interpolator=PolynomialLPV(degree=2), n_columns=3
)

# %%
# Resonance frequencies (rad/s) at a position between the measured ones, and the truth:

truth = modal.model(true_parameters(0.6)).poles()
pd.DataFrame(
    {"model": np.abs(beam.at(0.6).poles())[::2], "truth": np.abs(truth)[::2]},
    index=["first mode", "second mode"],
).round(2)
