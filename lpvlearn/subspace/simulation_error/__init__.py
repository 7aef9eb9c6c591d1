"""Models by least squares on the simulation error, and the noise in it."""
