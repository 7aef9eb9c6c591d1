"""Every public name, called with what a caller may give by mistake or by malice.

The call ends right or with an error that teaches, and in nothing else: no hang, no
error from the depths, no NaN for a result, no unstable model without a word.

    LPVLEARN_FUZZ_CASES=100000 python -m pytest -m slow tests/fuzz

is the night's run, of other cases every night; CI runs 2,000 that are always the same.
"""

import importlib
import inspect
import os
import signal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .calls import calls
from .hostile import hostile
from .outcomes import GOOD, Hangs, outcome_of

CI_CASES = 2000
N_CASES = int(os.environ.get("LPVLEARN_FUZZ_CASES", CI_CASES))
SECONDS = 20  # after which a call hangs

ROOMS = (
    "lpvlearn",
    *(
        f"lpvlearn.{room}"
        for room in ("datasets", "inspection", "lpv", "metrics", "models")
    ),
)

# Results of other names, which nobody writes by hand, and what takes no arguments.
NOT_CALLED = {"ArmResponse", "PeakGains", "NoiseModel"}
NOT_CALLED |= {"load_flexible_arm", "load_varying_spring"}


def test_every_public_name_is_called():
    public = {
        name
        for room in map(importlib.import_module, ROOMS)
        for name in room.__all__
        if inspect.isclass(getattr(room, name)) or callable(getattr(room, name))
    }
    called = {name.split(".")[0].split("(")[0] for name in calls()}
    assert public - called <= NOT_CALLED


@pytest.mark.slow
def test_valid_calls_are_right():
    for name, call in calls().items():
        if call.weight:
            found = outcome_of(lambda call=call: call.function(**call.arguments))
            assert found.kind in GOOD[:2], (name, found)


def ring(*_):
    raise Hangs


@pytest.fixture
def alarm():
    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def cases_of(call):
    total = sum(call.weight for call in calls().values())
    return max(1, round(N_CASES * call.weight / total)) if call.weight else 0


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, c in calls().items() if cases_of(c)])
def test_spoiled_calls_teach(name, alarm):
    call = calls()[name]

    @given(st.data())
    @settings(
        max_examples=cases_of(call),
        deadline=None,
        database=None,
        derandomize=N_CASES == CI_CASES,
        suppress_health_check=list(HealthCheck),
    )
    def spoil(data):
        names = st.sampled_from(sorted(call.arguments))
        some = data.draw(st.lists(names, min_size=1, max_size=2, unique=True))
        spoiled = {name: data.draw(hostile(call.arguments[name])) for name in some}
        signal.alarm(SECONDS)
        found = outcome_of(lambda: call.function(**{**call.arguments, **spoiled}))
        signal.alarm(0)
        allowed = found.kind == "not finite" and found.detail.startswith(call.open)
        assert found.kind in GOOD or allowed, (found, spoiled)

    spoil()
