"""How a command ends: its exit status, after an error, Ctrl-C or a signal too."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

_INTERRUPTED = 130  # a shell's status of a program that Ctrl-C ended
_SIGNALLED = 128  # a shell's status of a program that a signal ended, and its number

# What the library calls an argument is an option here.
_OPTIONS = (
    (r"missing='split' \(of SubspaceLTI\)|missing='split'", "--missing split"),
    (r"norm='hinf' \(in a pipeline, efficient=False\)", "--hinf"),
    (
        r"(score with )?make_bft_scorer\(initial_state='estimate'\)"
        r"( or, of samples after the transient, make_bft_scorer\(burn_in=\.\.\.\))?",
        "take --initial-state estimate",
    ),
    (r"initial_state='estimate'", "--initial-state estimate"),
    (
        r"Divide a column of milliseconds by 1000, or give dates or time differences, "
        r"which tell their unit",
        "Give --time-unit where they are not",
    ),
    (r"dates instead: pandas\.to_datetime\(.*?, unit='(\w+)'\)", r"--time-unit \1"),
    (
        r"Convert text of dates with pandas\.to_datetime, of numbers with "
        r"pandas\.to_numeric",
        "Write dates as 2026-03-04 10:15:00.05, or numbers",
    ),
    (r" \(pandas\.Series\.dt\.tz_localize, with ambiguous='infer'\)", ""),
    (r"thousands=',' where it parts", "write them without where it parts"),
    (r"pandas\.read_csv\(decimal=','\)", "give --decimal ','"),
    (r"pandas\.read_csv\(.*?thousands=.*?\)", "write them without"),
    (r"`tol`", "`--levels`"),
    (r"`(inputs|scheduling|experiment|time|order|missing)`", r"`--\1`"),
    (r"`(operating|sampling)_(point|time)`", r"`--\1-\2`"),
)

_ENDING = ("SIGTERM", "SIGHUP")  # where a system has them


def status_of(name: str, command: Callable[[], None]) -> int:
    """Run a command: 0, or 1 after an error, of which the message is shown."""
    try:
        with _signals_raise():
            command()
    except BrokenPipeError:  # a reader such as head has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        return _INTERRUPTED
    except (ValueError, TypeError, OSError, RuntimeError, MemoryError) as error:
        print(f"lpvlearn {name}: {in_options(str(error))}", file=sys.stderr)
        return 1
    return 0


def in_options(text: str) -> str:
    """A message of the library in the words of the command."""
    for words, option in _OPTIONS:
        text = re.sub(words, option, text)
    return text


@contextmanager
def _signals_raise() -> Iterator[None]:
    """Have signals end the block as an exception does: what is open is closed."""
    before = {}
    if threading.current_thread() is threading.main_thread():  # no other one may
        numbers = [getattr(signal, s) for s in _ENDING if hasattr(signal, s)]
        before = {number: signal.signal(number, _end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, frame: Any) -> NoReturn:
    raise SystemExit(_SIGNALLED + number)
