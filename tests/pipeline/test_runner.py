"""A step at several points: failures, and what is told on the way."""

import time

import joblib
import numpy as np
import pytest
from joblib import Memory
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    SubspaceLTI,
)
from lpvlearn.exceptions import Told, warn
from lpvlearn.pipeline.running.runner import Done, PointRunner, tell_skipped

from ..conftest import (
    spring_pipeline,
    spring_tables,
)


def runner(memory, **options):
    return PointRunner(**{"n_jobs": None, "verbose": 0, "on_error": "raise", **options},
                       memory=memory)  # fmt: skip


@pytest.mark.parametrize(
    ("on_error", "n_jobs"),
    [("raise", None), ("skip", None), pytest.param("raise", 2, marks=pytest.mark.slow)],
)
def test_a_failure_that_all_points_share_names_none(spring, on_error, n_jobs):
    pipeline = spring_pipeline(
        local=SubspaceLTI(order=400), on_error=on_error, n_jobs=n_jobs
    )
    with pytest.raises(ValueError, match="^`order` must be at most .*400"):
        pipeline.fit(*spring[:2])


def test_different_failures_everywhere_tell_the_first(spring):
    X, y, _, _ = spring
    unequal = (X["kappa"] < 0.2) | (X["time"] < 4 + X["kappa"])
    pipeline = spring_pipeline(local=SubspaceLTI(order=400), on_error="skip")
    with pytest.raises(
        ValueError, match="every .* failed. First operating point 0 .*400"
    ):
        pipeline.fit(X[unequal], y[unequal])


def test_what_is_known_of_points_stands_for_itself():
    runs = runner(Memory(None), on_error="skip")
    old = Done("old", [Told("told before", UserWarning)])
    with pytest.warns(UserWarning, match=r"left out operating point 1 .*: not here"):
        found = runs.run("a step", _refuse, [(0,), (1,)], np.eye(2), [old, None])
    assert found == [old, None]


def _refuse(_):
    raise ValueError("not here")


def when(_):
    """The time at which this is done."""
    return time.time()


@pytest.mark.slow
def test_steps_begun_are_done_while_something_else_is():
    arguments, kappa = [(k,) for k in range(4)], np.arange(4.0)[:, None]
    steps = runner(Memory(None), n_jobs=2)
    steps.run("steps", when, arguments, kappa)  # processes begin
    begun = steps.start("steps", when, arguments, kappa)
    time.sleep(2.0)
    waited = time.time()
    assert max(done.result for done in begun()) < waited


# -- what the points warn of -----------------------------------------------------------


def noisy(number):
    """A step that warns: of what all points share, and of what is its own."""
    warn("A shared cause.", ConvergenceWarning)
    warn("A shared cause.", ConvergenceWarning)
    if number == 1:
        warn("A cause of its own.")
    if number == 3:
        raise ValueError("It fails.")
    return number


def run(n_points, *, verbose=0, n_jobs=None, on_error="raise"):
    runner = PointRunner(n_jobs, verbose, on_error, Memory(None))
    arguments = [(k,) for k in range(n_points)]
    return runner.run("steps", noisy, arguments, np.arange(float(n_points))[:, None])


@pytest.mark.slow
@pytest.mark.parametrize("n_jobs", [None, 2])
def test_what_points_warn_of_comes_with_their_results(n_jobs):
    found = run(3, n_jobs=n_jobs)  # a warning would be an error
    assert [done.result for done in found] == [0, 1, 2]
    assert [len(done.told) for done in found] == [2, 3, 2]


def test_threads_do_not_mix_what_they_warn_of():
    with joblib.parallel_config("threading"):
        found = run(3, n_jobs=3)
    assert [len(done.told) for done in found] == [2, 3, 2]


def test_backends_that_send_all_results_at_once_serve_as_well():
    with joblib.parallel_config("multiprocessing"):  # as that of Ray
        found = run(3, n_jobs=2)
    assert [done.result for done in found] == [0, 1, 2]


def test_a_failure_still_tells_what_was_warned_of():
    with pytest.warns(UserWarning) as caught:
        with pytest.raises(ValueError, match=r"point 3 \(scheduling 3\): It fails\."):
            run(4)
    texts = [str(w.message) for w in caught]
    own = "A cause of its own. (At operating point 1 (scheduling 1).)"
    assert texts == ["A shared cause. (At all operating points.)", own]


def test_what_differs_in_numbers_is_told_once_with_their_ranges():
    """Names that hold digits (H2, p_3, [1]) are not numbers: these stay apart."""
    texts = [f"{x} times H2 is far (`p_value_` 1e-{k})." for x, k in
             ((2.5, 30), (-10, 4), (9.0, 5))]  # fmt: skip
    names = ["p_1 is open.", "p_2 is open.", "p_2 is open."]
    found = [
        Done(None, [Told(text, UserWarning), Told(name, ConvergenceWarning)])
        for text, name in zip(texts, names, strict=True)
    ]
    with pytest.warns(UserWarning) as caught:
        tell_skipped([*found, None], np.arange(4.0)[:, None])
    one, two = "operating point 1 (scheduling 1)", "operating point 2 (scheduling 2)"
    zero = "operating point 0 (scheduling 0)"
    assert [str(w.message) for w in caught] == [
        "-10 to 9.0 times H2 is far (`p_value_` 1e-30 to 1e-4). "
        f"(At {zero}, {one}, {two}.)",
        f"p_1 is open. (At {zero}.)",
        f"p_2 is open. (At {one}, {two}.)",
    ]


@pytest.mark.slow
def test_a_progress_bar_stays_whole(capsys):
    """Warnings come after the bar, once, at the points that they are about."""
    X, y = spring_tables(n_samples=150)
    poor = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    with pytest.warns(ConvergenceWarning, match="comes no nearer") as caught:
        LocalLPVPipeline(
            SubspaceLTI(2, horizon=8),
            GrayBoxRestructurer(poor, n_starts=1),
            scheduling="kappa",
            experiment="run",
            time="time",
            verbose=1,
        ).fit(X, y)
    shown = capsys.readouterr().err
    assert "restructuring: 100%" in shown and "Warning" not in shown
    texts = [str(w.message) for w in caught if "no nearer" in str(w.message)]
    assert len(texts) == 1 and texts[0].endswith("(At all operating points.)")
    assert {w.filename for w in caught} == {__file__}


@pytest.mark.filterwarnings("ignore:A shared cause", "ignore:A cause of its own")
def test_a_bar_that_a_failure_ends_is_closed(capsys):
    with pytest.raises(ValueError, match="It fails"):
        run(4, verbose=1)
    shown = capsys.readouterr().err
    assert "3/4" in shown and shown.endswith("\n")
