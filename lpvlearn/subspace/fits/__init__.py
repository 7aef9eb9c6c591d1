"""One fit of samples: its options, what is kept of it, and its simulation."""
