"""Bounded time: searches end at their best point, and say so."""

import warnings

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer
from lpvlearn.restructuring import deadline
from lpvlearn.restructuring.deadline import bounded, time_is_up

from .conftest import CASES, off_structure


def test_a_block_within_another_ends_with_it():
    with bounded(1e-9), bounded(1e3):
        assert time_is_up()
    with bounded(1e3):
        with bounded(1e-9):
            assert time_is_up()
        assert not time_is_up()
    assert not time_is_up()


class Ticks:
    """A clock that goes by one with every look, in place of seconds."""

    def __init__(self):
        self.now = 0

    def __call__(self):
        self.now += 1
        return float(self.now)


def black_box():
    structure, params = CASES["two_masses"]
    return structure, off_structure(
        structure.model(params), np.random.default_rng(0), 0.03
    )


def fitted(structure, model, **options):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit = GrayBoxRestructurer(structure, **options).fit_model(model)
    return fit, [str(warning.message) for warning in told]


@pytest.mark.broad
@pytest.mark.parametrize("options", [{}, {"norm": "h2"}])
def test_more_time_never_makes_worse_and_too_little_is_told(monkeypatch, options):
    structure, model = black_box()
    whole, told = fitted(structure, model, **options)
    assert not any("max_time" in message for message in told)
    monkeypatch.setattr(deadline, "perf_counter", Ticks())
    errors = []
    for seconds in (1, 40, 150):
        cut, told = fitted(structure, model, max_time=seconds, **options)
        errors.append(cut.objective_)
        late = any("ended at `max_time`" in message for message in told)
        assert late or cut.objective_ <= whole.objective_ * (1 + 1e-6)
        assert cut.lti_.is_stable
    enough, told = fitted(structure, model, max_time=1e6, **options)
    assert not any("max_time" in message for message in told)
    np.testing.assert_allclose(enough.params_, whole.params_)
    assert errors[0] > errors[1] >= errors[2] * (1 - 1e-9)


def test_the_bundle_ends_in_time(monkeypatch):
    structure, model = black_box()
    monkeypatch.setattr(deadline, "perf_counter", Ticks())
    _, told = fitted(structure, model, max_time=150, solver="bundle")
    assert any("ended at `max_time`" in message for message in told)


def test_an_exact_fit_in_time_is_told_of_no_more():
    structure, params = CASES["spring_mass"]
    _, told = fitted(structure, structure.model(params), max_time=60.0)
    assert told == []


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, "long"])
def test_no_time_is_refused(seconds):
    structure, model = black_box()
    with pytest.raises(ValueError, match="`max_time` must be a positive number"):
        GrayBoxRestructurer(structure, max_time=seconds).fit_model(model)
