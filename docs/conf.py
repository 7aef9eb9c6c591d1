"""Sphinx configuration of the documentation."""

from __future__ import annotations

import importlib.metadata
import re
import sys
import textwrap
import warnings
from pathlib import Path
from typing import Any

from sphinx.ext import autosummary
from sphinx_gallery.sorting import FileNameSortKey

sys.path.insert(0, str(Path(__file__).parent))
from landing import draw_landing_picture
from messages import write_page

project = "lpvlearn"
author = "The lpvlearn developers"
copyright = author
release = importlib.metadata.version("lpvlearn")
version = release

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas also without a network
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "start", "guide", "how_to", "examples"]
smartquotes = False  # messages are found by the characters they have
html_static_path = ["_static"]
html_css_files = ["lpvlearn.css"]

# -- API reference ---------------------------------------------------------------------

autosummary_generate = True
# A summary does not end at "Eq. (1)".
autosummary.WELL_KNOWN_ABBREVIATIONS += ("Eq.",)
autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# -- executed pages --------------------------------------------------------------------

sphinx_gallery_conf = {
    "examples_dirs": ["start", "guide", "how_to", "examples"],
    "gallery_dirs": ["auto_start", "auto_guide", "auto_how_to", "auto_examples"],
    "within_subsection_order": FileNameSortKey,
    "filename_pattern": r"/plot_",
    "backreferences_dir": "generated/backreferences",
    "doc_module": ("lpvlearn",),
    "reference_url": {"lpvlearn": None},
    "abort_on_example_error": True,
    "capture_repr": ("_repr_html_", "__repr__"),
    "matplotlib_animations": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 3600,
    "plot_gallery": True,
    "download_all_examples": False,
}
# Warnings on the pages: without a path of the machine that built them, and wrapped.
warnings.formatwarning = lambda message, category, *_, **__: (
    textwrap.fill(f"{category.__name__}: {message}", 88) + "\n"
)
# Pickles of this setting hold a class of sphinx-gallery, which Sphinx says aloud.
suppress_warnings = ["config.cache"]
warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")

# -- HTML ------------------------------------------------------------------------------

html_theme = "pydata_sphinx_theme"
html_title = "lpvlearn"
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "default",
}
html_sidebars = {page: [] for page in ("index", "how_good", "messages", "glossary")}
html_context = {"default_mode": "light"}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True


# -- docstrings ------------------------------------------------------------------------


def make_restructured_text(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Adapt docstrings, which are written to be read in a terminal.

    A fitted attribute that is named without backticks, such as order_, is no reference
    to a target.
    """
    for i in range(len(lines)):
        if not re.match(r"\s*(>>>|\.\.)", lines[i]):
            parts = re.split(r"(`+[^`]*`+)", lines[i])
            parts[::2] = [
                re.sub(r"(?<=\w)_(?!\w)", r"\\_", part) for part in parts[::2]
            ]
            lines[i] = "".join(parts)


def mend_links_of_sources(
    app: Any, pagename: str, template: str, context: dict[str, Any], doctree: Any
) -> None:
    """Links from sources to their documentation, by the name that stands there.

    viewcode takes one module for all that a file defines; a file's classes may be
    documented under a package, and its functions at the top.
    """

    def mended(link: re.Match[str]) -> str:
        page, anchor = link.groups()
        short = page.rsplit(".", 1)[-1]
        _, found, member = anchor.partition(f".{short}")
        return f'generated/{page}.html#{page if found else anchor}{member}"'

    if pagename.startswith("_modules/"):
        context["body"] = re.sub(
            r'generated/([\w.]+)\.html#([\w.]+)"', mended, context["body"]
        )


def make_pages(app: Any) -> None:
    """What is made from the code before Sphinx reads: messages, the first picture."""
    write_page()
    draw_landing_picture()


def setup(app: Any) -> None:
    """Register the hooks, those of docstrings after numpydoc's own."""
    app.connect("autodoc-process-docstring", make_restructured_text, priority=900)
    app.connect("builder-inited", make_pages, priority=100)  # before the gallery
    app.connect("html-page-context", mend_links_of_sources)
