"""What became of a call: right or taught, or one of the classes that may not be."""

import contextlib
import re
import signal
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from sklearn.exceptions import NotFittedError

import lpvlearn
from lpvlearn import LPVStateSpace, StateSpace

ROOT = str(Path(lpvlearn.__file__).parent)
HERE = str(Path(__file__).parent)

GOOD = ("right", "warned", "taught")
# After which a call hangs: of the processor, and of any clock (it waits, or is asleep).
SECONDS, WAITED = 20, 300

# Who may refuse a table beside this library: it stands on scikit-learn's checks.
CHECKS = ("sklearn/utils", "sklearn/base.py", "sklearn/metrics/_regression.py")

REFUSALS = (ValueError, TypeError, NotFittedError, AttributeError, OSError, ImportError)

# A message that teaches names an argument, a column or a place, and what it got.
NAMES = re.compile(
    r"`[^`]+`|\bX\b|\by\b|[Cc]olumn|[Ee]xperiment|operating point|y_true"
    r"|scheduling \[|scheduling variable|feature name|[Ii]nput variables"
    r"|Found array|Input contains"
)
GOT = re.compile(
    r"[Gg]ot|[Ff]ound |contains|not supported|not known|missing|expecting|is None"
    r"|beyond all|different number|diverges within|but your input has"
)


class Outcome(NamedTuple):
    """The class of a call's end, and what tells it."""

    kind: str
    detail: str = ""


class Hangs(BaseException):
    """A call went on for longer than it may."""


def outcome_of_spoiled(call, spoiled):
    """What became of a call with arguments in the place of valid ones, in time.

    A value that is no number is right where the call's documentation says so. Files go
    to a folder that does not last.
    """

    def in_time():
        with _ringing():
            return call.function(**{**call.arguments, **spoiled})

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        found = outcome_of(in_time)
    open = found.kind == "not finite" and found.detail.startswith(call.open)
    return Outcome("right", found.detail) if open else found


@contextlib.contextmanager
def _ringing():
    """Raise `Hangs` in a block that goes on for too long."""
    clocks = {signal.SIGPROF: signal.ITIMER_PROF, signal.SIGALRM: signal.ITIMER_REAL}
    before = {number: signal.signal(number, _ring) for number in clocks}
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WAITED)
    try:
        yield
    finally:
        for number, clock in clocks.items():
            signal.setitimer(clock, 0)
            signal.signal(number, before[number])


def _ring(*_):
    raise Hangs


def outcome_of(call):
    """Call, and tell what became of it."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            result = call()
        except Hangs:
            return Outcome("hang", _where_in_library(traceback.extract_stack()))
        except Exception as error:
            return _refusal(error)
        own = [w for w in given if not _leaked(w)]
        leaked = [w for w in given if _leaked(w)]
    if leaked:
        w = leaked[0]
        return Outcome("leaked warning", f"{w.filename}:{w.lineno}: {w.message}")
    if not own:
        bad = not_finite(result)
        if bad:
            return Outcome("not finite", bad)
        bad = unstable(result)
        if bad:
            return Outcome("unstable", bad)
    return Outcome("warned" if own else "right", str(own[0].message) if own else "")


def _leaked(warning):
    """Whether a warning is another library's, which teaches nothing of this one."""
    return not isinstance(warning.message, UserWarning | RuntimeWarning) or (
        bool(
            re.match(
                r"(overflow|underflow|invalid value|divide by zero|All-NaN|Mean of|"
                r"Degrees of freedom|Casting complex|Singular matrix|Ill-cond|Passing)",
                str(warning.message),
            )
        )
    )


def _refusal(error):
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    message = f"{type(error).__name__}: {error}"
    detail = f"{message[:300]} @ {_where_in_library(frames)}"
    by_checks = any(place in last.filename for place in CHECKS)
    own = any(f.filename.startswith(ROOT) for f in frames)
    if isinstance(error, OSError) or (own and last.filename.startswith(HERE)):
        return Outcome("taught", detail)  # of a file, or of the user's own function
    if not last.filename.startswith(ROOT) and not by_checks:
        return Outcome("depths", detail)
    taught = isinstance(error, REFUSALS) and NAMES.search(message)
    if not taught or not GOT.search(message):
        return Outcome("untaught", detail)
    return Outcome("taught", detail)


def _where_in_library(frames):
    own = [f for f in frames if f.filename.startswith(ROOT)]
    places = [f"{f.filename[len(ROOT) + 1 :]}:{f.lineno}" for f in own[-2:]]
    last = frames[-1]
    return " > ".join([*places, f"{Path(last.filename).name}:{last.lineno}"])


def not_finite(result, place="result"):
    """The place of a NaN or an infinity in what a call returned, or None."""
    if isinstance(result, float | complex | np.number | np.ndarray):
        values = np.atleast_1d(result)
        if values.dtype.kind not in "fc" or np.isfinite(values).all():
            return None
        kind = "NaN" if np.isnan(values).any() else "infinity"
        return f"{kind} in {place} of shape {np.shape(result)}"
    if isinstance(result, pd.DataFrame | pd.Series):
        table = result.to_frame() if isinstance(result, pd.Series) else result
        return not_finite(table.select_dtypes("number").to_numpy(), place)
    if isinstance(result, StateSpace):
        return not_finite([result.A, result.B, result.C, result.D], place)
    if isinstance(result, dict):
        result = list(result.items())
    if isinstance(result, list | tuple):
        for k, part in enumerate(result):
            bad = not_finite(part, f"{place}[{k}]")
            if bad:
                return bad
    return None


def unstable(result):
    """Whether a fit ended in an unstable model."""
    model = getattr(result, "lti_", None) or getattr(result, "lpv_", None)
    if isinstance(model, StateSpace) and not model.is_stable:
        asked = getattr(result, "integrating", None) is not None
        if not asked or (np.abs(model.poles()) > 1.0 + 1e-9).any():
            return f"poles {model.poles()}"
    if isinstance(model, LPVStateSpace):
        low, high = model.scheduling_range
        kappa = np.linspace(low, high, 9)
        poles = model.silenced().frozen_poles(kappa)
        if poles.real.max(initial=-1.0) >= 0:
            return f"poles {poles.real.max()}"
    return None
