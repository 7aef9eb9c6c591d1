"""``python -m lpvlearn``: the options that it refuses."""

import pytest

from lpvlearn.__main__ import main


@pytest.mark.parametrize("option", ["--realizations", "--degree", "--jobs"])
def test_counts_below_one_are_refused(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([option, "0"])
    assert "must be at least 1. Got 0." in capsys.readouterr().err
