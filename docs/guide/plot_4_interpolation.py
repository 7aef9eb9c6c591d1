r"""
.. _guide_interpolation:

Interpolation
=============

Step 5. Every operating point :math:`\kappa_i` has its parameter vector
:math:`\vartheta_i`, all in one common state basis. A polynomial of the scheduling
variables carries each parameter from point to point, Eq. (35) of the paper:

.. math::

   \vartheta(\kappa) = \vartheta_0 + \vartheta_1 \kappa + \dots + \vartheta_d \kappa^d .
"""

# %%
# The whole method up to here is a pipeline of three estimators:

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
# interpolated one (:math:`H_\infty` norm, relative), the FIT of Eq. (36) is a summary
# per matrix:

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
# FIT rises with the degree, always: it is measured on the points themselves. To
# *choose*, leave points out (:ref:`guide_validation`).
#
# Other interpolators
# -------------------
# Any regressor of scikit-learn with several outputs will do; it also says itself what
# it makes of scheduling values outside the identified range. ``PolynomialLPV`` can warn
# about them or hold the border's value (``extrapolation="clip"``).

from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import SplineTransformer

spline = make_pipeline(SplineTransformer(n_knots=3, degree=3), LinearRegression())
spline.fit(kappa, pipeline.parameters_)
comparison = pd.DataFrame(
    {
        "parabola": pipeline.interpolator_.predict([[0.5]])[0],
        "cubic spline": spline.predict([[0.5]])[0],
        "truth": data.arm.parameters(np.arccos(0.5)),
    },
    index=pipeline.parameters_.columns,
)
comparison.round(1).head(8)

# %%
# Poles between the points
# ------------------------
# The interpolated model is stable at every operating point; between them, look:

display = PoleDisplay.from_estimator(pipeline)
