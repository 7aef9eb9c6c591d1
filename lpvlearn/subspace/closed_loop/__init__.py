"""Samples of a plant in a loop: noticed, and identified nevertheless."""
