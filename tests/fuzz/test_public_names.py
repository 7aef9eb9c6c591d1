"""Every public name, called with what a caller may give by mistake or by malice.

The call ends right or with an error that teaches, and in nothing else: no hang, no
error from the depths, no NaN for a result, no unstable model without a word.

    LPVLEARN_FUZZ_CASES=100000 python -m pytest -m slow tests/fuzz

is the night's run, of other cases every night; CI runs 2,000 that are always the same.
`survey.py` counts what becomes of as many, and stops at none.
"""

import importlib
import inspect
import os

import pytest
from hypothesis import HealthCheck, given, settings

from .calls import calls, shares
from .hostile import spoiled
from .outcomes import GOOD, outcome_of, outcome_of_spoiled

CI_CASES = 2000
N_CASES = int(os.environ.get("LPVLEARN_FUZZ_CASES", CI_CASES))

ROOMS = (
    "lpvlearn",
    *(
        f"lpvlearn.{room}"
        for room in ("datasets", "inspection", "lpv", "metrics", "models")
    ),
)

# Results of other names, which nobody writes by hand, and what takes no arguments.
NOT_CALLED = {"ArmResponse", "PeakGains", "NoiseModel"}
NOT_CALLED |= {"data_folder", "load_flexible_arm", "load_varying_spring"}


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


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, k in shares(N_CASES).items() if k])
def test_spoiled_calls_teach(name):
    call = calls()[name]

    @given(spoiled(call.arguments))
    @settings(
        max_examples=shares(N_CASES)[name],
        deadline=None,
        database=None,
        derandomize=N_CASES == CI_CASES,
        suppress_health_check=list(HealthCheck),
    )
    def spoil(arguments):
        found = outcome_of_spoiled(call, arguments)
        assert found.kind in GOOD, (found, arguments)

    spoil()
