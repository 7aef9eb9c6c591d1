"""Templates come from strangers' files: a cell ends at once, in its value or its error.

The table is of 60 strings that would run code, hang, exhaust memory or the stack, or
say two things to two readers, were they read by `eval` or without limits.
"""

import signal
import tracemalloc

import pytest

from lpvlearn import GrayBoxStructure

SECONDS = 1  # of CPU for a cell; milliseconds were measured
MEGABYTES = 32  # beside the cell itself; 1 was measured

CODE = (
    *("__import__('os').system('true')", "exec('1')", "eval('1')", "open('x')"),
    *("().__class__", "p.__class__", "p.real", "(lambda: 1)()", "lambda p: p"),
    *("[p for p in (1,)]", "{p}", "{'p': 1}", "(p := 1)", "p if 1 else q", "p or q"),
    *("not p", "p < q", "p == 1", "f'{p}'", "'p'", '"p"', "b'p'", "p; q", "import os"),
    *("p[0]", "p(1)", "sin(p)", "*p", "**p", "await p", "yield p", "...", "@p", "`p`"),
)

LARGE = (
    "1" * 1_000_000,
    "p" * 1_000_000,
    "(" * 100_000 + "p" + ")" * 100_000,
    "(" * 4_000 + "p" + ")" * 4_000,
    "-" * 100_000 + "p",
    "-" * 9_000 + "p",
    "p" + "+1" * 500_000,
    " " * 1_000_000,
    "9**9**9**9",
    "2**(2**(2**99))",
    "10**400",
    "1" + "0" * 400,
    "1e999999999",
    "0x" + "f" * 5_000,
    "1" * 5_000,
    "1/1e-320",
)

STRANGE = (
    *("nan", "inf", "-Infinity", "1j", "True", "None", "p\0", "p\\\nq", "p q", "2p"),
    *("1_000", "p\u200b", "٣", "½", "p²", "p − q", "𝟏", "1,5", "p // 2", "p % 2"),
)


@pytest.fixture
def limits():
    """A cell that takes longer or more memory than it may ends in another error."""

    def ring(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGVTALRM, ring)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    tracemalloc.start()
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    signal.signal(signal.SIGVTALRM, before)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEGABYTES * 2**20


def cell(text):
    return GrayBoxStructure.from_template([[text]], [[1]], [[1]])


def test_the_table_has_sixty_strings():
    assert len({*CODE, *LARGE, *STRANGE}) >= 60


@pytest.mark.parametrize("text", [*CODE, *LARGE, *STRANGE], ids=lambda t: ascii(t)[:30])
def test_hostile_strings_end_in_the_error_of_the_cell(text, limits):
    with pytest.raises(ValueError, match=r"^`A\[0\]\[0\]` must be") as told:
        cell(text)
    assert len(str(told.value)) < 500


@pytest.mark.parametrize(
    "text, names",
    [("p" + "+q" * 2_000, 2), ("+".join(f"p{k}" for k in range(900)), 900)],
)
def test_long_sums_are_read(text, names, limits):
    assert cell(text).n_params == names


def test_names_are_kept_as_they_are_written():
    for name in ("µ", "μ", "K", "\u212a", "ﬁ"):  # Python's own parser changes three
        assert cell(name).parameter_names == (name,)


@pytest.mark.parametrize("pair", [("µ", "μ"), ("K", "\u212a"), ("fi", "ﬁ")])
def test_names_that_only_look_alike_are_told(pair):
    with pytest.raises(ValueError, match="must look different. Got .*write them alike"):
        GrayBoxStructure.from_template([[pair[0]]], [[pair[1]]], [[1]])


@pytest.mark.parametrize(
    "sizes", [(10**9, 1, 1), (1, 10**9, 1), (1, 1, 10**9), (500, 500, 500)]
)
def test_forms_beyond_memory_are_refused(sizes, limits):
    with pytest.raises(ValueError, match="must (make at most|be fewer)"):
        GrayBoxStructure.full(*sizes)
