"""What the errors of a fitted model tell of it and of the samples."""
