"""Times of steps, and what is told of those that last."""

import time

import pytest

from lpvlearn.pipeline.running.stopwatch import Stopwatch


def test_a_stopwatch_adds_up_the_times_of_the_steps():
    watch = Stopwatch({"a": 1.0})
    for name in ("b", "a", "b"):
        with watch.step(name):
            pass
    table = watch.table()
    assert table["step"].tolist() == ["a", "b", "total"]
    assert watch.seconds["a"] > 1.0 and watch.seconds["b"] > 0.0
    assert table["seconds"].tolist()[-1] == sum(watch.seconds.values())


@pytest.mark.parametrize(
    ("verbose", "bar", "told"),
    [(1, False, "figures ...\n"), (1, True, ""), (0, False, "")],
)
def test_steps_that_last_are_told_where_wanted(capsys, monkeypatch, verbose, bar, told):
    monkeypatch.setattr("lpvlearn.pipeline.running.stopwatch._PATIENCE", 0.0)
    watch = Stopwatch(verbose=verbose)
    with watch.step("figures", bar=bar):
        time.sleep(0.1)
    assert capsys.readouterr() == ("", told)
    assert watch.seconds["figures"] >= 0.1
