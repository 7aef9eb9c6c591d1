"""What a process does that works for another one: it ends with it.

This room imports no other, nor NumPy: a process that begins has it seconds before the
rest of the library, in which the one that it works for may end.
"""

from __future__ import annotations

import os
import threading
import time
from functools import cache

WATCH = 0.5  # seconds between two looks at other processes


@cache
def end_with_parent(parent: int) -> None:
    """Have this process end when the one that started it, and asks, has.

    Loky's wait for more work when that one was killed, some for ever, and what they
    share with it stays in memory.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
