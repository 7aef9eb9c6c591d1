"""The paper's tables as text."""

from lpvlearn.paper.text import aligned_text


def test_printed_columns_are_aligned() -> None:
    assert aligned_text([["a", "longer"], ["b", "1.5"]]) == "a         b\nlonger  1.5"
