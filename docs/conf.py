"""Settings of Sphinx; `make docs` builds docs/_build/html."""

from __future__ import annotations

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_extensions")]

project = "morgs_mi"
author = "The morgs_mi authors"
copyright = "The morgs_mi authors, BSD 3-Clause"
extensions = ["myst_nb", "sphinx.ext.autodoc", "plain_docstrings", "package_pages", "web_pages"]
exclude_patterns = ["_build", "_extensions"]
html_theme = "furo"
html_title = "morgs_mi"
html_show_sourcelink = False

# Notebooks show the outputs that are committed; tests/test_notebooks.py runs them.
nb_execution_mode = "off"
myst_heading_anchors = 3

add_module_names = False
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
toc_object_entries = False

# Every reference is checked, but for types of other packages, whose inventories are online.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!morgs_mi\.).*")]
