"""What the library says, in the words of the command."""

import pandas as pd
import pytest

from lpvlearn.command.ending import in_options
from lpvlearn.data.text_numbers import reading_of
from lpvlearn.data.timestamps import time_in_seconds


def test_the_command_has_options_for_what_the_library_advises():
    said = in_options(
        "Splits must keep experiments whole; where they cannot, score with "
        "make_bft_scorer(initial_state='estimate') or, of samples after the transient, "
        "make_bft_scorer(burn_in=...)."
    )
    assert said.endswith("where they cannot, take --initial-state estimate.")
    assert in_options("Name the `inputs`.") == "Name the `--inputs`."


@pytest.mark.parametrize("text", ["0,5", "1,500", "1,500.00", "1.500,00", "1 500"])
def test_numbers_in_text_are_no_matter_of_python(text):
    said = in_options(reading_of(text))
    assert said and "pandas" not in said and "thousands=" not in said
    assert ("--decimal ','" in said) == (text in ("0,5", "1,500"))


def test_times_are_no_matter_of_python():
    with pytest.raises(ValueError, match="Convert text") as caught:
        time_in_seconds(pd.Series(["noon"]), "t")
    said = in_options(str(caught.value))
    assert said.endswith("Write dates as 2026-03-04 10:15:00.05, or numbers.")
    with pytest.warns(UserWarning) as told:
        time_in_seconds(pd.Series([1.7e12]), "t")
    said = in_options(str(told[0].message))
    assert said.endswith("if these are milliseconds since 1970, give --time-unit ms.")
