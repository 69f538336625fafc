"""Paths and addresses of the documentation's pages, for help and messages."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["DOCUMENTATION", "page", "with_pages"]

DOCUMENTATION = "https://morgs-mi.readthedocs.io/"
"""Address of the documentation."""

_CHECKOUT = Path(__file__).parents[2]


def page(name: str) -> str:
    """Return the path of a page in the checkout, such as docs/flow.md, or its address where there is no checkout."""
    path = f"docs/{name}.md"
    return path if (_CHECKOUT / path).is_file() else f"{DOCUMENTATION}en/latest/{name}.html"


def with_pages(text: str) -> str:
    """Return a text with the result of `page` in place of every path of a page, such as docs/flow.md."""
    return re.sub(r"\bdocs/([\w/-]+)\.md\b", lambda match: page(match[1]), text)
