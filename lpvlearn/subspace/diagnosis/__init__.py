"""What is said of a fit: what the samples lack, and what is wrong with the model."""
