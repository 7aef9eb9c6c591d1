"""``lpvlearn fit``, ``predict`` and ``report``: a user's own tables at the shell."""

from .parsers import add_commands

__all__ = ["add_commands"]
