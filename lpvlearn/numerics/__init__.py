"""Pure functions on arrays: the mathematics below the estimators."""
