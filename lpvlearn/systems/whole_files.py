"""Files that are whole or not there, whatever happens while they are written."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """A new file, which takes the place of `target` at once when it is on the disk.

    An error in the block leaves what was there.

    >>> import tempfile
    >>> place = Path(tempfile.mkdtemp()) / "told"
    >>> with whole_file(place) as file:
    ...     _ = file.write(b"all of it")
    >>> place.read_bytes(), [path.name for path in place.parent.iterdir()]
    (b'all of it', ['told'])
    """
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    if hasattr(os, "O_DIRECTORY"):  # the name, too, shall survive a loss of power
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        with suppress(OSError):  # not every file system can
            os.fsync(folder)
        os.close(folder)
