r"""
.. _guide_restructuring:

Restructuring
=============

Step 4, the heart of the method. Given the black box :math:`\mathfrak{G}(s) =
\mathfrak{C}(sI - \mathfrak{A})^{-1}\mathfrak{B}` of one operating point and a
structure :math:`(A(\vartheta), B(\vartheta), C(\vartheta))` that physics gives, find
the parameters :math:`\vartheta`. This page derives how, from the problem to the
certificate, with one worked example.
"""

# %%
# The structure
# -------------
# A structure is a template: numbers where physics knows them, names where it does not.
# The arm's, Eq. (32) of the paper: positions integrate rates (zeros and ones), forces
# divided by masses are sixteen unknown numbers ``p1``, ..., ``p16``.

import numpy as np
import pandas as pd

from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
structure = data.structure
theta = np.arange(1.0, 17.0)  # to see where each parameter stands
structure.matrices(theta)[0]

# %%
# It is written as ``GrayBoxStructure.from_template([[0, 0, 0, 0, 1, 0], ..., ["p1",
# "p5", "p9", "p13", 0, 0], ...], B, C)``; entries may be affine, such as ``"-p9"`` or
# ``"2*k - 1"``. Anything smooth goes into ``GrayBoxStructure.from_function(f,
# initial)``.
#
# The problem
# -----------
# If the black box were exact, some change of the state variables :math:`T` would turn
# it into the structure:
#
# .. math::
#
#    \mathfrak{A} T = T A(\vartheta), \qquad \mathfrak{B} = T B(\vartheta), \qquad
#    \mathfrak{C} T = C(\vartheta).
#    \tag{3}
#
# The unknowns multiply each other, the equations only hold approximately for an
# identified model, and *how* approximately says little: a small residual in (3) can be
# a large error near a resonance, since
#
# .. math::
#
#    \Sigma(s, \vartheta)
#    &= C(\vartheta)(sI - A(\vartheta))^{-1}B(\vartheta) - \mathfrak{G}(s) \\
#    &= \mathfrak{C}(sI - \mathfrak{A})^{-1}(T B(\vartheta) - \mathfrak{B})
#     + (C(\vartheta) - \mathfrak{C}T)(sI - A(\vartheta))^{-1}B(\vartheta) \\
#    &\quad + \mathfrak{C}(sI - \mathfrak{A})^{-1}
#      (T A(\vartheta) - \mathfrak{A}T)(sI - A(\vartheta))^{-1}B(\vartheta)
#
# multiplies the residuals by both resolvents :math:`(sI - \cdot)^{-1}`, which peak at
# the poles. So drop :math:`T` and compare what can be measured, the transfer functions:
#
# .. math::
#
#    \min_\vartheta \ \|\Sigma(\cdot, \vartheta)\|_\infty
#    = \min_\vartheta \ \max_{\omega \in [0, \infty]} \
#      \sigma_1\big(\Sigma(j\omega, \vartheta)\big).
#    \tag{6}
#
# :math:`\sigma_1` is the largest singular value: the greatest gain, over all directions
# of the input, of the error. Two consequences. The orders of the two models may differ.
# And the optimum *is* an error bound: for every input, the energy of the difference of
# the two outputs is at most :math:`\|\Sigma\|_\infty^2` times that of the input.
#
# The start
# ---------
# The objective (6) is not convex, and a search needs a place to begin. Users are not
# asked for one. The equations of (3) without a parameter are linear in :math:`T`, for
# instance the rows of zeros and ones; they are solved exactly, :math:`T = T_0 + \sum_k
# z_k N_k`, and what is left is a small nonlinear least-squares problem in :math:`z`. It
# is solved from ``n_starts`` random points at each of two time scales; every candidate
# is judged by its *frequency response*, and the best start a least-squares fit of the
# response. At the first operating point:

from lpvlearn import GrayBoxRestructurer, SubspaceLTI

here = data.X["experiment"] == 0
roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
local = SubspaceLTI(6, feedthrough=False, **roles).fit(data.X[here], data.y[here])
black_box = local.lti_.to_continuous().balance()

restructurer = GrayBoxRestructurer(structure).fit_model(black_box)
restructurer.starts_

# %%
# Relative errors of the fits, best first. The search ends where two rounds of different
# starts agree on a fit, or where its error is the black box's own: rounding, or the
# noise that `realizations` or `estimates` tell of. Wrong basins exist, and their fits
# end further from the black box; that is why there are many starts, and a best fit that
# one round alone reached is warned of. A pipeline has one more means against them:
# every point is fitted also from its neighbours' parameters, until nothing improves.
#
# Parts that may change places
# ----------------------------
# No response tells the first mode of a modal form from the second, nor one lag in
# series from the other: such structures have several optima of the same error, and
# every operating point would end in any of them. The LPV model needs one family. A
# pipeline finds the permutations of the parameters that leave all responses as they
# are (and further optima from the neighbours' parameters), and takes of all families
# the one of the highest evidence as smooth functions of the scheduling variable:
# branches that cross keep their slopes. Where another family is nearly as plausible, it
# warns with the names of the parameters. Other values may give the same responses at
# all points without any parts of like names: of two tanks in series either may be the
# slow one, with another gain at the inlet. Any two parameters are exchanged to find
# such values, which are told. ``with_ranges``, ``with_bounds`` or a first guess decide
# which part has which number, and which family is taken.
#
# Parts of *all* points may be interchanged. Of modes side by side that is a matter of
# names: their states change places in the same way everywhere. Of parts in series, as
# the two coils of a filter of which one varies, the states are scaled anew by every
# value of the scheduling variable, and where it moves the mirror image is another LPV
# model. No local experiment tells them apart; experiments that move do: with a
# ``refiner`` the pipeline begins at the one that simulates these best. Without such
# experiments it warns, where what inputs leave behind at one end of the range would
# differ at the other one by a fifth.
#
# Two parts that noise has merged at a point have no places at all: the parameters there
# are any, with infinite covariance, and no smooth function goes through them. Then the
# polynomial is fitted to the black boxes of all points together, each in the
# coordinates of its own uncertainty:
# :math:`\min_c \sum_k |z_k(S_k c)|^2`, where :math:`S_k c` are the parameters at point
# k. It is taken, and told, where the black boxes do not refute it. So it is where they
# refute the form through the parameters: the covariance of these tells of small
# changes, and what data hardly tell apart changes by large ones.
#
# The norm, and all of its peaks
# ------------------------------
# :math:`\gamma > 0` is a singular value of :math:`\Sigma(j\omega)` exactly if the
# Hamiltonian matrix
#
# .. math::
#
#    H(\gamma) = \begin{bmatrix}
#      \mathscr{A} & \gamma^{-1} \mathscr{B}\mathscr{B}^{\mathsf T} \\
#      -\gamma^{-1} \mathscr{C}^{\mathsf T}\mathscr{C} & -\mathscr{A}^{\mathsf T}
#    \end{bmatrix}
#
# of the realization :math:`(\mathscr{A}, \mathscr{B}, \mathscr{C})` of :math:`\Sigma`
# has the eigenvalue :math:`j\omega`. So the set of frequencies where the curve is above
# a level is read off eigenvalues, and raising the level until it is empty gives the
# norm, to ten digits, without a frequency grid. One more eigenvalue problem just below
# the top gives
# *every* peak, not only the highest. That is what makes the minimisation work: at an
# optimum several peaks are equally high, and a step that lowers one raises another
# unless it knows of both.
#
# The path from least squares
# ---------------------------
# The least-squares fit is a good start in a good basin, but its highest peak may be
# twice as high as it must be, and the way down is no straight line: a search on the
# maximum itself follows the ridge on which several peaks are equal, and where the ridge
# bends its steps are tiny. So the first part of the way leads over a smooth function.
# With a level
# :math:`t` above the error at all frequencies :math:`\omega_k` of a grid, and
# :math:`\mu > 0`,
#
# .. math::
#
#    \psi_\mu(\vartheta) = \min_t \ \log t
#    - \mu \sum_k \log\det \left( I - t^{-2} \Sigma_k^H \Sigma_k \right),
#    \qquad \Sigma_k = \Sigma(j\omega_k, \vartheta).
#
# For :math:`\mu \to \infty` its minimiser is the least-squares fit, for
# :math:`\mu \to 0` that of the highest singular value; between them runs the *central
# path* of interior-point methods. Newton's method with exact second derivatives follows
# it while :math:`\mu` shrinks and the peaks that are met join the grid. Where the
# structure is far from the black box, the path is followed from the best fit of each of
# several basins.
#
# Coefficients are seldom good coordinates. Along a straight step :math:`h` in them the
# response :math:`G(\vartheta)` soon leaves its tangent, though most of that bend
# belongs to the coordinates alone: it lies *within* the tangent space. Steps are taken
# along geodesics of the response instead,
#
# .. math::
#
#    \vartheta + h + \tfrac12 a, \qquad
#    a = -J^{+}\, G''[h, h], \quad J = \partial G / \partial \vartheta,
#
# with the *geodesic acceleration* :math:`a` (Transtrum and Sethna, 2012) and a Hessian
# to match. Canonical forms, which hold every model of their order and have the worst
# coordinates of all, are searched in local coordinates of the set of these models;
# their parameters are read off the result.
#
# The minimisation
# ----------------
# From its end the optimum is a few steps away. Each peak :math:`f_i(\vartheta) =
# \sigma_1(\Sigma(j\omega_i(\vartheta), \vartheta))` is a smooth function, with the
# gradient
#
# .. math::
#
#    \frac{\partial f_i}{\partial \vartheta_k}
#    = \mathrm{Re}\; u_i^H \frac{\partial \Sigma(j\omega_i)}{\partial \vartheta_k} v_i,
#
# :math:`u_i, v_i` the singular vectors; their maximum is not smooth. Both solvers take
# steps :math:`h` from a model of all peaks at once,
#
# .. math::
#
#    \min_{h,\, t} \ t + \tfrac12 h^{\mathsf T} Q\, h \quad\text{subject to}\quad
#    f_i + \nabla f_i^{\mathsf T} h \le t \ \text{ for all } i.
#
# With ``solver="sqp"`` (default) :math:`Q` is the exact Hessian of the Lagrangian,
# including the motion of the peaks, in a trust region, and convergence is quadratic.
# With ``solver="bundle"`` it is the paper's proximity control: :math:`Q` is a multiple
# of the identity and the planes of earlier points are kept, Eq. (18)-(21). Both end at
# the same optimum.
#
# Not every error matters alike: ``frequency_weight`` takes a band in rad/s or a
# weighting model. And ``norm="h2"`` minimises the mean square over frequency instead of
# the largest value.
#
# An identified black box is not known equally well everywhere. Let :math:`g` be its
# distance from the structure at all frequencies, and :math:`\Sigma` the covariance of
# its response. ``norm="covariance"``, and :class:`~lpvlearn.LocalLPVPipeline` by
# default (``efficient=True``), goes on from the H-infinity optimum to
#
# .. math::
#
#    \min_{\vartheta}\ g(\vartheta)^{\mathsf T}\, \Sigma^{+} g(\vartheta),
#
# whose parameters are statistically efficient. If the structure is true, the minimum is
# a chi-square: ``report_`` has it with its p-value; a warning tells where noise
# does not explain the distance. ``efficient=False`` keeps the H-infinity optimum.
#
# The worked figure
# -----------------
# :class:`~lpvlearn.inspection.ErrorDisplay` draws :math:`\sigma_1(\Sigma(j\omega))`.
# For a clear picture, a case in which the structure cannot be exact: a mass on a spring
# is driven by an actuator with a lag of 0.03 s, and the model that we want has no
# actuator.

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.inspection import ErrorDisplay

driven = StateSpace(
    A=[[0, 1, 0], [-1, -0.1, 1], [0, 0, -30]], B=[[0], [0], [30]], C=[[1, 0, 0]]
)
spring = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
)
start = spring.check_params({"k": 1.0, "c": 0.1, "b": 1.0})  # forget the actuator

reduced = GrayBoxRestructurer(spring, init=start).fit_model(driven)
display = ErrorDisplay.from_estimator(
    reduced, driven, start=start, omega=np.geomspace(0.7, 1.4, 500)
)

# %%
# Before (dash-dotted), with the mass's true parameters: the lag turns the phase at the
# resonance. After (solid): the norm has been pressed down until several peaks are
# equally high, the *active* ones, marked. To lower any of them, another must rise. The
# parameters moved to take over a part of what the lag does:

pd.DataFrame(
    {"start": start, "optimum": reduced.params_}, index=spring.parameter_names
).round(4)

# %%
# The certificate
# ---------------
# How do we know that this is an optimum? The shortest vector in the convex hull of the
# active gradients, relative to the error, is ``stationarity_``: zero means that no
# direction lowers all active peaks. A positive ``second_order_`` (smallest
# eigenvalue of the reduced Hessian) makes it a strict local minimum; a saddle is left
# along its negative curvature. ``convergence_`` sums it up in a word: "optimal",
# "nearly" (stationary to 1e-3 only), "saddle" or "no". That there is no
# better one far away is not certified; ``lower_bound_`` is what no model of this order
# can do better than (a Hankel singular value of the black box).

pd.Series(
    {
        "norm of the error": reduced.error_,
        "relative to the black box": reduced.relative_error_,
        "lower bound": reduced.lower_bound_,
        "stationarity": reduced.stationarity_,
        "second order": reduced.second_order_,
        "iterations": reduced.n_iter_,
    }
)

# %%
# Its course: objective, predicted decrease, size of the trust region and number of
# active peaks at each iteration. The last steps converge quadratically.

reduced.history_

# %%
# When the structure fixes a gain
# -------------------------------
# Back to the arm. At standstill its outputs equal its references, whatever the
# parameters: :math:`G(0) = I`. The black box was identified from 3 s of noisy data, in
# which the slowest mode (0.7 rad/s) just about moves, so that :math:`\mathfrak{G}(0)`
# is off by a little. No parameter can lower that part of the error: it is a *floor*. A
# minimisation that ignored this would stop at once, since everything below the floor is
# invisible to the norm. So the floor is recognised (a peak whose gradient is zero),
# reported, and set aside: first by a weight that vanishes at its frequency, then the
# peaks below it are minimised as they are, among all parameters that keep the norm at
# the floor:

display = ErrorDisplay.from_estimator(restructurer, black_box)
pd.Series(
    {
        "norm of the error": restructurer.error_,
        "structural floor": restructurer.structural_floor_,
        "highest peak apart from it": restructurer.remaining_error_,
    }
)

# %%
# The dashed line is the floor. A dot marks each frequency at which the error has one of
# its equally high peaks below. Grey: the least-squares fit that the minimisation
# began with, whose peaks near the resonances are higher.
#
# The result
# ----------
# Sixteen numbers from 3 s of noisy data, no initial guess, beside the truth:

truth = data.arm.parameters(data.theta2[0])
pd.DataFrame(
    {"found": restructurer.params_, "truth": truth}, index=structure.parameter_names
).round(2)

# %%
# Inputs between samples
# ----------------------
# A structure in continuous time has to know what its inputs do between samples. Those
# that a controller puts out stay (hold of order zero). Those that a sensor reads, a
# force or a flow, go on: as held ones they come half a sample late, and parameters pay
# for that. Of smooth inputs a pipeline tells it by the distance of the structure from
# the local models in units of their uncertainty (``discretization="auto"``): where
# straight lines between samples leave far less, it takes a hold of order one, for all
# inputs alike, as the LPV model does then (``lpv_.hold``). Inputs that bend much within
# a sample (less than some ten samples in a period) ask for a faster one, and held ones
# beside smooth ones for ``"zoh"`` or ``"foh"``, by which matter more. Single models are
# converted by ``lti.to_continuous("foh")`` and ``to_discrete(dt, "foh")``.
#
# Integrators and undamped oscillators
# ------------------------------------
# A structure that has a pole at zero for all parameters, as a position has by ``x1' =
# x2``, shares it with the black box. The distance of two integrators is infinite unless
# their gains agree: both are divided by it, and the error is weighted by ``s / (s +
# c)``, which compares gains at low frequencies. Poles that a record puts near zero,
# growing ones too, are estimates of it, several of a chain as ``x1' = x2, x2' = b u``.
# An oscillator without damping, as a liquid that sloshes at a known frequency ``w0``,
# is shared likewise: by rows ``[0, 1]`` and ``[-w0**2, 0]`` of fixed entries, and a
# weight that is zero at ``w0``. ``known_poles=[1j * w0, -1j * w0]`` names such poles,
# and refuses a structure that does not have them.
#
# Large problems
# --------------
# ``max_time=10`` ends the search after ten seconds at the best point it has, and says
# so.
#
# Is the structure identifiable?
# ------------------------------
# Two parameters that only appear as a product cannot be told apart by any experiment.
# The derivative of the frequency response tells: its rank, and how far a relative error
# of the response may grow into relative errors of the parameters (``condition``; by
# name, ``sensitivities``). Times the black box's own relative error this tells which
# parameters are known.

restructurer.identifiability_
