"""Notebooks of the built documentation: python check_notebooks.py _build/html.

Every executed page has one, with a link to it; its cells are the statements of the
page, which ran when it was built, in their order.
"""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

DOCS = Path(__file__).parent


def statements(code: str) -> list[str]:
    """What the code does, without its comments and texts."""
    found = [ast.dump(statement) for statement in ast.parse(code).body]
    texts = ("Expr(value=Constant(value='", 'Expr(value=Constant(value="')
    return [one for one in found if not one.startswith(texts)]


def faults(root: Path) -> list[str]:
    """What is wrong with the notebook of a page, for every page."""
    notebooks = {path.stem: path for path in root.glob("_downloads/*/*.ipynb")}
    found = []
    for script in sorted(DOCS.glob("*/plot_*.py")):
        if script.parent.name.startswith("auto_"):  # the copies that Sphinx makes
            continue
        page = root / f"auto_{script.parent.name}" / f"{script.stem}.html"
        notebook = notebooks.get(script.stem)
        if notebook is None:
            found.append(f"{script.name}: no notebook")
            continue
        if f"{notebook.parent.name}/{notebook.name}" not in page.read_text("utf-8"):
            found.append(f"{script.name}: no link to its notebook")
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        code = ["".join(c["source"]) for c in cells if c["cell_type"] == "code"]
        if statements("\n".join(code)) != statements(script.read_text("utf-8")):
            found.append(f"{script.name}: its notebook does something else")
    return found


if __name__ == "__main__":
    told = faults(Path(sys.argv[1]))
    print("\n".join(told) or "every page has its notebook")
    sys.exit(bool(told))
