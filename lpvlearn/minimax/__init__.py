"""Minimisation of a largest value: what the problem is, and its solvers."""
