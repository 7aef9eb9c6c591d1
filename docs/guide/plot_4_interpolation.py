r"""
.. _guide_interpolation:

Interpolation
=============

Step 5. Every operating point :math:`\kappa_i` has its parameter vector
:math:`\vartheta_i`, all in one common state basis. A function of the scheduling
variables carries each parameter from point to point: a polynomial, Eq. (35) of the
paper,

.. math::

   \vartheta(\kappa) = \vartheta_0 + \vartheta_1 \kappa + \dots + \vartheta_d \kappa^d ,

or a rational function with one denominator for all parameters, as equations of motion
:math:`M(\kappa)\, \ddot q = \dots` give it. The parameters know their covariances, and
these tell which form may be true.
"""

# %%
# The whole method up to here is a pipeline of three estimators. Its ``memory`` keeps
# what the first two found: another interpolator is a matter of a second.

import tempfile

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
)
from lpvlearn.datasets import load_flexible_arm

data = load_flexible_arm()
roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
pipeline = LocalLPVPipeline(
    local=SubspaceLTI(horizon=60, feedthrough=False),
    restructurer=GrayBoxRestructurer(data.structure),
    interpolator=PolynomialLPV(degree=2),
    memory=tempfile.mkdtemp(),
    **roles,
)
pipeline.fit(data.X, data.y)

# %%
# A sample of the interpolator is an operating point: seven rows here. The first
# parameters:

pipeline.parameters_.loc[:, "p1":"p6"].round(1)

# %%
# Their standard deviations, to first order, from the covariance of the black boxes
# (of averaged realizations: from their spread). Where a black box does not minimise the
# simulation error, its covariance is not known, and they are NaN.

pipeline.parameters_std_.loc[:, "p1":"p6"].round(1)

# %%
# Points: identified parameters. Line: the interpolation. The truth is known here and
# drawn beside them.

import numpy as np

from lpvlearn.inspection import ParameterDisplay, PoleDisplay

kappa = pipeline.operating_points_
truth = np.array([data.arm.parameters(np.arccos(k)) for k in kappa[:, 0]])
display = ParameterDisplay.from_estimator(pipeline, others={"truth": truth})

# %%
# Some panels are magnified noise: mind the scales. ``p1`` varies by one per cent only,
# and ``p5`` is small beside ``p6``, to which it adds in the same equation.
#
# Which degree?
# -------------
# A low one, with more points than coefficients, smooths the noise of the local models;
# a high one follows them. ``report_`` has the distance from each gray-box model to the
# interpolated one (:math:`H_\infty` norm, relative), and a FIT in which every parameter
# counts alike. That of Eq. (36), as in Table 3, counts entries by their size, per
# matrix:

import pandas as pd

from lpvlearn import parameter_fit

rows = {}
for degree in range(1, 5):
    smooth = PolynomialLPV(degree).fit(kappa, pipeline.parameters_)
    fitted = data.structure.matrices(smooth.predict(kappa))
    local = data.structure.matrices(pipeline.parameters_.to_numpy())
    rows[degree] = {
        name: parameter_fit(local[k].ravel(), fitted[k].ravel())
        for k, name in enumerate("AB")
    }
pd.DataFrame(rows).T.rename_axis("degree").round(1)

# %%
# FIT rises with the degree, always: it is measured on the points themselves. What tells
# a true form is the distance from the points in units of their standard deviations: its
# square is about the number of degrees of freedom. By default the pipeline's
# interpolator is :class:`~lpvlearn.AutoLPV`, which tries polynomials and rational
# functions and takes the simplest one that the data support.

pipeline.set_params(interpolator=None).fit(data.X, data.y)
pipeline.interpolator_.selection_.round(1)

# %%
# No polynomial comes near: the arm's parameters are entries of
# :math:`M(\kappa)^{-1} K`, and so rational functions. The pipeline says which form it
# took; where no form can be true, or the covariances are not known, the interpolation
# goes through the points and keeps their shape (:class:`~lpvlearn.SplineLPV`), or
# follows smooth laws by cubic pieces, over the logarithm of a length or a mass too,
# where points left out show that this is nearer. A warning tells of points that the
# others do not foresee, and of gaps that the two kinds of curves cross far apart.

pipeline.interpolator_.form_

# %%
# Where points differ in quality, the covariances weigh them, in
# :class:`~lpvlearn.PolynomialLPV` and :class:`~lpvlearn.RationalLPV` alike. At a degree
# that is too low they are not used (``weighted_``): the errors are then those of the
# form, and precise points would bend it.
#
# Other interpolators
# -------------------
# Any regressor of scikit-learn with several outputs will do; it also says itself what
# it makes of scheduling values outside the identified range. Those of this library can
# warn about them or hold the border's value (``extrapolation="clip"``).

from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import SplineTransformer

spline = make_pipeline(SplineTransformer(n_knots=3, degree=3), LinearRegression())
spline.fit(kappa, pipeline.parameters_)
parabola = PolynomialLPV(degree=2).fit(kappa, pipeline.parameters_)
comparison = pd.DataFrame(
    {
        "rational": pipeline.interpolator_.predict([[0.5]])[0],
        "parabola": parabola.predict([[0.5]])[0],
        "cubic spline": spline.predict([[0.5]])[0],
        "truth": data.arm.parameters(np.arccos(0.5)),
    },
    index=pipeline.parameters_.columns,
)
comparison.round(1).head(8)

# %%
# The choice in a picture: where forms agree, and where they differ most.

display = ParameterDisplay.from_estimator(
    pipeline, forms={"parabola": parabola, "spline": spline}, names=["p2", "p5", "p9"]
)

# %%
# Poles between the points
# ------------------------
# The interpolated model is stable at every operating point; between them, look:

display = PoleDisplay.from_estimator(pipeline)
