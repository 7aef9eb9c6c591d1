"""Numbers along an axis. Imports Matplotlib, as who draws does first."""

from __future__ import annotations

from typing import Any

from matplotlib.ticker import ScalarFormatter


class ShortNumbers(ScalarFormatter):
    """Numbers of few digits, and their common power of ten at the end of the axis.

    That alone is set as a formula, each of which takes Matplotlib some milliseconds.
    """

    def __init__(self) -> None:
        super().__init__(useOffset=False, useMathText=False)
        self.set_powerlimits((-3, 4))

    def get_offset(self) -> Any:
        self.set_useMathText(True)
        power = super().get_offset()
        self.set_useMathText(False)
        return power
