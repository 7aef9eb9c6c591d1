"""What fits see of experiments, and its compression."""
