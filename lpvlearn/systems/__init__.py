"""Pure functions on the arrays of a linear system: responses, norms, simulation.

Arguments mean the same in every room. `A, B, C, D` have the shapes (n, n),
(n, n_inputs), (n_outputs, n), (n_outputs, n_inputs); `dt` is the sampling time in
seconds, None in continuous time; frequencies are in rad/s. Nothing is checked here but
what cannot be computed.
"""
