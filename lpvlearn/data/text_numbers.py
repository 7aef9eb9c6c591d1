"""Numbers that stand in a table as text: how to read the file that has them."""

from __future__ import annotations

import re
from typing import Any

# Groups of three digits with a mark between them, and perhaps decimals
_GROUPED = re.compile(
    r"[+-]?\d{1,3}(?P<mark>[.,' \u00a0\u202f])\d{3}(?P<more>((?P=mark)\d{3})*)"
    r"(?:(?P<point>[.,])\d+)?"
)

_WITH_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def reading_of(value: Any) -> str:
    """How text like this is read as numbers; empty where it is none.

    >>> reading_of("0,5")
    "These numbers are text with a decimal comma: pandas.read_csv(decimal=',')."
    >>> reading_of("1,500.00")
    "These numbers are text with thousands separators: pandas.read_csv(thousands=',')."
    >>> reading_of("run 1")
    ''
    """
    text = value.strip() if isinstance(value, str) else ""
    found = _GROUPED.fullmatch(text)
    mark, point = found.group("mark", "point") if found else ("", "")
    if found and mark != point and (found["more"] or point or mark not in ",."):
        decimal = "decimal=',', " if point == "," or mark == "." else ""
        return (
            "These numbers are text with thousands separators: "
            f"pandas.read_csv({decimal}thousands={mark!r})."
        )
    if not _WITH_COMMA.fullmatch(text):
        return ""
    or_thousands = ", or thousands=',' where it parts thousands" if found else ""
    return (
        "These numbers are text with a decimal comma: "
        f"pandas.read_csv(decimal=','){or_thousands}."
    )
