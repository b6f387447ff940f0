"""Sphinx builds the site from the documents as they stand: sphinx-build -E -W -c docs . build/site."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = "tlq"
html_title = "tlq"
extensions = ["myst_parser", "sphinx.ext.autodoc", "docs.generate"]

# The source is the whole repository, so that a link between two documents is right on the site and in a file browser.
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*.md", "benchmarks/README.md"]
exclude_patterns = [
    path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in ("docs", "benchmarks")
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
default_role = "code"
smartquotes = False

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True

# Nothing is fetched, neither by the build nor by the page: system fonts, no scripts from elsewhere.
html_theme = "alabaster"
html_theme_options = {
    "page_width": "1100px",
    "body_max_width": "none",
    "show_powered_by": False,
    "font_family": "system-ui, sans-serif",
    "head_font_family": "system-ui, sans-serif",
}
html_math_renderer = "mathml"
html_copy_source = False
html_show_copyright = False
