"""Numbers that are text: which marks they have."""

import pytest

from lpvlearn.data.text_numbers import reading_of


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("0,0", "decimal=','"),
        ("-1,5e3", "decimal=','"),
        ("1,500", "decimal=','), or thousands=',' where it parts thousands"),
        ("1,500.00", "thousands=','"),
        ("1,234,567", "thousands=','"),
        ("1.234,5", "decimal=',', thousands='.'"),
        ("1.234.567", "decimal=',', thousands='.'"),
        ("1 234,5", "decimal=',', thousands=' '"),
    ],
)
def test_marks_tell_how_a_file_is_read(text, options):
    assert f"pandas.read_csv({options}" in reading_of(text)


@pytest.mark.parametrize("text", ["1.5", "1.500", "12", "1,2,3", "1,500,00", "a", None])
def test_other_text_tells_nothing(text):
    assert reading_of(text) == ""
