"""What the tests of the restructuring share."""

from lpvlearn.restructuring.transfer import Target


def target_of(model):
    """A model as the error systems hold it."""
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)
