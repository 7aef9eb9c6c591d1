"""Pure functions on the arrays of a linear system: responses, norms, simulation."""
