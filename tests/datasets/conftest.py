"""Arms that several rooms test with."""

import numpy as np

from lpvlearn.datasets import FlexibleArm

# Every length and density different, so that no mix-up of links goes unseen.
LOPSIDED = FlexibleArm(
    l1=0.35, l2=0.25, rho1=0.9, rho2=0.6, EI1=70.0, EI2=20.0, elbow_mass=0.7
)
ANGLES = np.pi * np.arange(1, 8) / 8
COARSE = {"integration_step": 1e-3}
