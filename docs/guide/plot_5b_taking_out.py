r"""
.. _guide_taking_out:

Taking the model out
====================

An identified model is of use where a controller is designed. What other programs take
of an :class:`~lpvlearn.LPVStateSpace`: coefficients, a linear-fractional form, or
frozen models over a grid. And before that: which experiment would make it better?
"""

# %%
import numpy as np

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    SubspaceLTI,
    gap,
    load,
    save,
    suggest_operating_point,
)
from lpvlearn.datasets import FlexibleArm, load_flexible_arm

data = load_flexible_arm()
pipeline = LocalLPVPipeline(
    SubspaceLTI(horizon=60, feedthrough=False),
    GrayBoxRestructurer(FlexibleArm().structure("momentum")),
    scheduling="kappa",
    experiment="experiment",
    time="time",
).fit(data.X, data.y)
lpv = pipeline.lpv_
print(pipeline.interpolator_.form_)

# %%
# Where to measure next
# ---------------------
# :func:`~lpvlearn.suggest_operating_point` ranks the middles between neighbouring
# operating points. "neighbour_gap" is how far the dynamics change from one neighbour to
# the other; "leave_one_out" how much the interpolated model there hangs on single
# points; "noise" what the covariances of the parameters make of it:

suggest_operating_point(pipeline).round(5)

# %%
# A rational form through seven points leaves little more than the noise. Without a
# structure the same experiments leave ten times as much and more, and another point
# helps most near the upper end, where neighbours differ most.
#
# All of these are nu-gaps: distances between 0 and 1 as a controller feels them. A
# controller that stabilises one model with a margin above the gap stabilises the other.
# :func:`~lpvlearn.gap` is the distance of any two models, unstable ones too. It depends
# on the units of the signals; the table takes such in which gains are about one.

round(gap(lpv.at(-0.8), lpv.at(0.8)), 3)

# %%
# Coefficients
# ------------
# Where the matrices are affine in the parameters (a template without E) and the
# interpolation has a form, the matrices have coefficients:
#
# .. math:: A(\kappa) = \frac{A_0 + A_1 \kappa + A_2 \kappa^2}
#           {d_0 + d_1 \kappa + d_2 \kappa^2}.

found = lpv.coefficients()
print(found.A.shape, found.denominator.round(3))
found.table().round(2)

# %%
# Entries that are constants stand in a column of their own. With
# ``normalized=True`` the powers are those of the variable mapped to [-1, 1], which is
# better conditioned where a range is far from zero (a speed of 900 to 1000 rpm).
#
# Linear-fractional form
# ----------------------
# Robust control takes the model as a constant matrix M with the scheduling variables
# fed back around it, :math:`w = \Delta(\kappa) z`:

lfr = lpv.lfr(normalized=True)
print(lfr, lfr.M.shape)
print(np.abs(lfr.at(0.3).A - lpv.at(0.3).A).max() / np.abs(lpv.at(0.3).A).max())

# %%
# The number in ``repetitions`` says how often kappa stands on the diagonal of Delta. In
# MATLAB's Robust Control Toolbox, with M from ``scipy.io.savemat``,
# ``lft(ureal("kappa", 0) * eye(n), M)`` is the uncertain matrix ``[A, B; C, D]``.
#
# Frozen models
# -------------
# ``grid`` gives a list of :class:`~lpvlearn.StateSpace`, ``to_control`` of
# ``control.StateSpace``, ``to_xarray`` one ``xarray.Dataset``, and ``to_mat`` a file
# for MATLAB's ``ssInterpolant``. All of them bear the names of the signals, and their
# units where the pipeline was told them (``units={"torque": "N m", "angle": "rad"}``):

models = lpv.grid(np.linspace(-0.8, 0.8, 17))
print(len(models), models[0])

# %%
# ::
#
#     lpv.to_mat("arm.mat", np.linspace(-0.8, 0.8, 17))
#
# and in MATLAB::
#
#     m = load("arm.mat"); g = ss(m.A, m.B, m.C, m.D, InputDelay=m.InputDelay);
#     g.SamplingGrid = m.SamplingGrid; lpv = ssInterpolant(g, m.offsets);
#
# The dataset has the scheduling variables as coordinates:
# ``ds = lpv.to_xarray(points)``, then ``ds["A"].sel(kappa=0.4)`` or
# ``ds["A"].interp(kappa=0.41)``.
#
# MATLAB interpolates the matrices linearly between the points, so take these close.
# With several scheduling variables, all combinations of some values become a
# rectangular grid. Offsets go along in ``m.offsets``. Coefficients, the
# linear-fractional form and ``to_control`` leave them out, to be taken from
# ``lpv.input_offset``, ``output_offset`` and ``state_offset``.
#
# Another program's opinion
# -------------------------
# Before a controller is built on it, let a program that shares no code with this one
# say what the model is:

frozen = lpv.at(0.4)
omega = np.logspace(-1, 3, 200)
response = frozen.frequency_response(omega)
print(f"H-infinity norm {frozen.hinf_norm():.10f}")

# %%
# harold needs NumPy below 2, and so an environment of its own (``pip install harold
# "numpy<2" "scipy<1.12"``). Through a file, ``np.savez("frozen.npz", A=frozen.A,
# B=frozen.B, C=frozen.C, D=frozen.D, omega=omega, response=response)``, there::
#
#     import harold
#     import numpy as np
#
#     m = np.load("frozen.npz")
#     G = harold.State(m["A"], m["B"], m["C"], m["D"])
#     print(harold.system_norm(G, p=np.inf))
#     rad = {"w_unit": "rad/s", "output_unit": "rad/s"}
#     found, _ = harold.frequency_response(G, m["omega"], **rad)
#     print(abs(np.moveaxis(found, -1, 0) - m["response"]).max())
#
# python-control does without slycot here, and without a file::
#
#     import control
#
#     G = frozen.to_control()
#     print(control.system_norm(G, "inf", method="scipy"))
#     found = control.frequency_response(G, omega).complex
#     print(abs(np.moveaxis(found, -1, 0) - response).max())
#
# ========================= ================= =========================
# Of this model             norm              largest difference of the
#                                             responses
# ========================= ================= =========================
# here                      1.0413117616
# harold 1.0.3              1.0413117753      3e-14
# python-control 0.10.2     1.0413122177      3e-14
# ========================= ================= =========================
#
# Their norms are found by bisection, to the 1e-6 that they are asked for; that of this
# library is exact but for rounding.
#
# Keeping it
# ----------
# :func:`~lpvlearn.save` writes a model or a fitted estimator to a file without code,
# :func:`~lpvlearn.load` builds it anew: equal to the bit, in later versions of the
# library, and from files of strangers. A file is whole or not there: the old one is
# replaced when the new one is on the disk.

import tempfile
from pathlib import Path

path = Path(tempfile.mkdtemp()) / "arm.zip"
save(pipeline, path)
same = load(path)
print(same.summary() == pipeline.summary())
print((same.predict(data.X) == pipeline.predict(data.X)).all())

# %%
# What a file holds, how other programs read it, and what it leaves out:
# :ref:`guide_files`. A structure that is a function of the user's is kept by its name;
# who loads it gives the function, ``load(path, function=...)``.
