"""Files that are whole or not there, whatever happens while they are written."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_FOLDER = (errno.ENOENT, errno.ENOTDIR)


def unwritten(place: str, error: OSError, advice: str | None = None) -> str:
    """That a place cannot be written, what the system says of it, and what to do."""
    if error.errno in _FULL:
        advice = "Free space there, or take another place."
    elif error.errno in _NO_FOLDER:
        advice = advice or "Make the folder that it is in, or take another place."
    else:
        advice = advice or "Take a place where you may write."
    return f"{place}: it cannot be written ({error.strerror or error}). {advice}"


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """A new file, which takes the place of `target` at once when it is on the disk.

    An error in the block leaves what was there. An OSError names the argument `path`,
    not the part, and says what to do.

    >>> import tempfile
    >>> place = Path(tempfile.mkdtemp()) / "told"
    >>> with whole_file(place) as file:
    ...     _ = file.write(b"all of it")
    >>> place.read_bytes(), [path.name for path in place.parent.iterdir()]
    (b'all of it', ['told'])
    """
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        try:
            with part.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        told = type(error)(unwritten(f"`path` {str(target)!r}", error))
        told.errno = error.errno
        raise told from error
    if hasattr(os, "O_DIRECTORY"):  # the name, too, shall survive a loss of power
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        with suppress(OSError):  # not every file system can
            os.fsync(folder)
        os.close(folder)
