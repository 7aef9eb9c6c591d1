"""Dead links of the built documentation: python check_links.py _build/html.

Pages and anchors within it; addresses elsewhere are not asked for.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """Targets and links of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.targets: set[str] = set()
        self.links: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        self.targets |= {known.get(name) or "" for name in ("id", "name")}
        wanted = known.get("href") if tag in ("a", "link") else known.get("src")
        if wanted:
            self.links.add(wanted)


def dead_links(root: Path) -> list[str]:
    """Every link to a file or an anchor that is not there, with its page."""
    pages = {
        path.resolve(): _Page(path)
        for path in sorted(root.rglob("*.html"))
        if "_static" not in path.parts
    }
    dead = []
    for path, page in pages.items():
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve()
            target = path if not parts.path else target
            anchor = unquote(parts.fragment)
            lost = target not in pages and not target.exists()
            if not lost and anchor and target in pages:
                lost = anchor not in pages[target].targets
            if lost:
                dead.append(f"{path.relative_to(root.resolve())}: {link}")
    return dead


if __name__ == "__main__":
    found = dead_links(Path(sys.argv[1]))
    print("\n".join(found) or "no dead links")
    sys.exit(bool(found))
