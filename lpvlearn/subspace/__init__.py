"""Step 3 of the method: a black-box model from the records of one operating point."""

from .estimator import SubspaceLTI

__all__ = ["SubspaceLTI"]
