"""``lpvlearn fit``, ``predict`` and ``report``: a user's own tables at the shell."""

from .. import __version__
from .parsers import add_commands

__all__ = ["__version__", "add_commands"]
