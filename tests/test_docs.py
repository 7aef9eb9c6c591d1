"""What the documentation says is true of the code."""

import ast
import io
import re
import runpy
import tokenize
import warnings
from pathlib import Path

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, StateSpace, SubspaceLTI, bft_score

from .conftest import spring_structure, spring_tables

DOCS = Path(__file__).resolve().parents[1] / "docs"

# A message with one of these words tells what to do.
REMEDY = (
    r"must|needs?|use|give|take|raise|lower|drop|fix|try|add|shorten|excite|update|"
    r"leave|call|identify|interpolate|convert|another|avoids|fill|have it found|begin"
)


@pytest.fixture
def messages(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    import messages

    return messages


def test_every_error_and_warning_stands_on_its_page(messages):
    found, relayed = messages.all_messages()
    assert relayed == messages.RELAYS
    page = messages.page()
    assert all(messages.escaped(message.text) in page for message in found)
    assert sum(message.is_warning for message in found) > 40
    assert len(found) > 440


def test_every_message_tells_what_to_do_or_its_page_does(messages):
    found, _ = messages.all_messages()
    speechless = [
        message.text
        for message in found
        if not re.search(rf"\b({REMEDY})\b", message.text, re.IGNORECASE)
        and not messages.remedy_of(message.text)
        and messages.section_of(message) != "Files"  # its head tells
    ]
    assert speechless == []
    texts = [message.text for message in found]
    spare = [k for k in messages.REMEDIES if not any(t.startswith(k) for t in texts)]
    assert spare == []


X, Y = spring_tables(n_samples=60)

COMPLAINTS = {
    "an option": lambda: SubspaceLTI(stability="no").fit(X[["force"]], Y),
    "a role": lambda: SubspaceLTI(inputs="froce").fit(X, Y),
    "a shape": lambda: bft_score(np.zeros((3, 1)), np.zeros((4, 1))),
    "an unstable model": lambda: GrayBoxRestructurer(spring_structure()).fit_model(
        StateSpace([[1.0]], [[1.0]], [[1.0]])
    ),
    "a horizon": lambda: SubspaceLTI(1, horizon=40, time="time", inputs="force").fit(
        X[:60], Y[:60]
    ),
    "a time column that is an input": lambda: SubspaceLTI(1, inputs=None).fit(
        X[["force", "time"]][:60], Y[:60]
    ),
}


@pytest.mark.parametrize("complaint", COMPLAINTS.values(), ids=COMPLAINTS)
def test_what_users_get_to_read_is_found_on_the_page(messages, complaint):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            complaint()
        except ValueError as error:
            told = [*(str(one.message) for one in told), str(error)]
        else:
            told = [str(one.message) for one in told]
    assert told
    patterns = [messages.pattern(m.text) for m in messages.all_messages()[0]]
    for text in told:
        assert any(pattern.fullmatch(text) for pattern in patterns), text


def test_links_that_lead_nowhere_are_found(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(DOCS)
    from check_links import dead_links

    one, two = tmp_path / "one.html", tmp_path / "sub" / "two.html"
    two.parent.mkdir()
    one.write_text('<a href="sub/two.html#here"></a><a href="https://x.org/y"></a>')
    two.write_text('<p id="here"></p><a href="../one.html"></a><a href="#here"></a>')
    assert dead_links(tmp_path) == []
    one.write_text('<a href="sub/two.html#there"></a><img src="three.png">')
    assert dead_links(tmp_path) == [
        "one.html: sub/two.html#there",
        "one.html: three.png",
    ]


# What is not written, and what is instead: British spelling, and the field's words.
TERMS = {
    r"noise realisation": "noise realization",
    r"(mini|maxi|opti)miz(e|ing)": "-mise",
    r"(linear|general|regular|stabil|initial|summar|factor|recogn)iz": "-ise",
    r"\bcolors?\b": "colour",
    r"behavior": "behaviour",
    r"neighbor": "neighbour",
    r"\bcenter": "centre",
    r"analyz": "analyse",
    r"\bdatasets\b": "data sets",
    r"timestamp": "time stamp",
    r"sub-space|eigen-value|feed-through": "one word",
    r"\bstate space model|\bgray box model|\bblack box model": "with a hyphen",
    r"blackbox|graybox|grey[- ]box": "black box, gray box",
    r"(?<!npy-)\b(matlab|Matlab)\b": "MATLAB",
    r"Scikit-Learn|[Ss]cikit [Ll]earn": "scikit-learn",
    r"h-infinity|H infinity": "H-infinity",
    r"\b(hankel|nyquist|laplace|gramian)": "a name, with a capital",
}


def prose_of(path):
    """What a page or a source says: no code, no names, no titles of papers."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        parts = [t.string for t in tokens if t.type == tokenize.COMMENT]
        documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
        found = [n for n in ast.walk(ast.parse(text)) if isinstance(n, documented)]
        text = "\n\n".join([*parts, *(ast.get_docstring(n) or "" for n in found)])
    quoted = r"```.*?```|``[^`]*``|`[^`]*`|\"[^\"]*\"|<[^>]*>"
    lines = (
        r"^# {5}[^\n]*|^ *(>>>|\.\.\.|\.\.) [^\n]*|^ +(link|:\w+):[^\n]*|^   [\w.]+\n"
    )
    return re.sub(f"{quoted}|{lines}", " ", text, flags=re.DOTALL | re.MULTILINE)


def test_terms_are_spelled_as_the_list_says():
    root = DOCS.parent
    pages = [*DOCS.rglob("*.rst"), *DOCS.rglob("*.py"), *root.glob("*.md")]
    pages = [
        p for p in pages if not any("auto_" in x or x == "generated" for x in p.parts)
    ]
    found = [
        f"{path.relative_to(root)}: {word[0]!r}, here {spelled}"
        for path in [*pages, *(root / "lpvlearn").rglob("*.py")]
        for prose in [prose_of(path)]
        for pattern, spelled in TERMS.items()
        for word in re.finditer(pattern, prose)
    ]
    assert found == []


def how_to(page):
    """What a page computes, by the names of its variables."""
    return runpy.run_path(str(DOCS / "how_to" / f"plot_{page}.py"))


@pytest.mark.slow
def test_ten_plants_are_found_from_their_responses_and_from_data():
    page = how_to("1_plants")
    plants = page["summary"]
    assert len(plants) == 10
    assert (plants["from the response"] < 1e-8).all()
    assert (plants["from data"] < 0.02).all()
    # Two standard deviations hold 95 %; errors of one plant are not independent.
    within = (plants["within +-"] * plants["parameters"]).sum()
    assert within > 0.85 * plants["parameters"].sum()
    assert "determines 3 of the 5" in str(page["told"][0].message)


def test_a_log_of_a_logger_becomes_the_heater_that_wrote_it():
    page = how_to("3_log")
    found, fan = page["heater"].parameters_, np.array([0.2, 0.4, 0.6])
    assert np.allclose(found["rate"], 0.01 + 0.02 * fan, rtol=0.01)
    assert np.allclose(found["gain"], 0.004, rtol=0.01)
    assert np.allclose(np.ravel(page["room"]), 21.0, atol=0.3)


@pytest.mark.slow
def test_the_scheduled_controller_does_what_no_fixed_one_does():
    page = how_to("4_close_the_loop")
    assert page["worst"].pop("scheduled") < 1 < min(page["worst"].values())
    errors = page["result"].filter(like="error")
    assert (errors.loc["scheduled"] < 0.8 * errors.loc["no controller"]).all()
    assert (errors.loc["scheduled"] < errors.loc["for the middle angle"]).all()
