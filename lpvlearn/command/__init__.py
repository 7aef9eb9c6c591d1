"""``lpvlearn fit``, ``predict`` and ``report``: a user's own tables at the shell."""

from .. import __version__

__all__ = ["__version__"]
