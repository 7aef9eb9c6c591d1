"""Derivatives of a function of the user."""

import threading
import warnings

import numpy as np

from lpvlearn.structures.map import numerical_jacobian


def test_threads_leave_the_warning_filters_alone():
    before = list(warnings.filters)

    def work():
        for _ in range(50):
            numerical_jacobian(
                lambda t: np.array([t[0] ** 2]), np.array([2.0]), np.ones(1)
            )

    threads = [threading.Thread(target=work) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert warnings.filters == before
