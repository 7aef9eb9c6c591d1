"""Fits of batches that come one by one, in memory that does not grow."""
