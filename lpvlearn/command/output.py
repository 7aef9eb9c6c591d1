"""Results whole or not at all: written aside, and put in their place at the end."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..pipeline.running.memory import unwritten

_PROBE = 2**16  # bytes that must find room before the work begins

_VANISHED = "The folder has vanished: do not move or clear it meanwhile."


@contextmanager
def whole_folder(target: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder that becomes `target` when the block ends well.

    Into a `target` that is there and not empty, files go one by one, if `overwrite`
    allows; others in it stay.
    """
    if target.exists() and not target.is_dir():
        raise ValueError(f"--output {target}: there is a file of that name.")
    filled = target.is_dir() and any(target.iterdir())
    if filled and not overwrite:
        raise ValueError(
            f"--output {target}: the folder is not empty. Take another one, or allow "
            "by --overwrite that files of the same names are replaced."
        )
    # that nothing can be written there is told now, not after the fit
    around = target if filled else target.parent
    with _told(target):
        around.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=around))
    try:
        with _told(target, aside):
            probe = aside / "probe"
            probe.write_bytes(bytes(_PROBE))
            probe.unlink()
            yield aside
        aside.chmod(0o777 & ~_umask())  # mkdtemp's is for the owner alone
        if target.is_dir() and not filled:
            target.rmdir()
        if not filled:
            aside.replace(target)
            return
        for file in sorted(aside.rglob("*")):
            place = target / file.relative_to(aside)
            if file.is_dir():
                place.mkdir(exist_ok=True)
            else:
                file.replace(place)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def whole_output(target: Path) -> Iterator[Path]:
    """A new file's path, which becomes `target` when the block ends well."""
    if target.is_dir():
        raise ValueError(f"--output {target}: there is a folder of that name.")
    with _told(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = tempfile.TemporaryDirectory(prefix=".lpvlearn.", dir=target.parent)
    with aside as name, _told(target, Path(name)):
        part = Path(name) / target.name
        yield part
        part.replace(target)


@contextmanager
def _told(target: Path, folder: Path | None = None) -> Iterator[None]:
    """Say of `target` what the system says of writing, or of writing in a folder."""
    try:
        yield
    except OSError as error:
        where = error.filename
        if folder and where is not None and not str(where).startswith(str(folder)):
            raise  # another file's
        gone = folder and (error.errno == errno.ENOENT or not folder.exists())
        advice = _VANISHED if gone else None
        raise OSError(unwritten(f"--output {target}", error, advice)) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
