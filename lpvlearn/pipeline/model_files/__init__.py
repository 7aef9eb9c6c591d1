"""Models in files without code."""
