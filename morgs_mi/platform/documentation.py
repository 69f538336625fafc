"""Help: docstrings of fields, and paths and addresses of the documentation's pages."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from contextlib import suppress
from dataclasses import is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

Class = TypeVar("Class")

DOCUMENTATION = "https://morgs-mi.readthedocs.io/"
"""Address of the documentation."""

CHECKOUT = Path(__file__).parents[2]


def page(name: str) -> str:
    """Return the path of a page in the checkout, such as docs/flow.md, or its address where there
    is no checkout.
    """
    path = f"docs/{name}.md"
    return path if (CHECKOUT / path).is_file() else f"{DOCUMENTATION}en/latest/{name}.html"


def with_pages(text: str) -> str:
    """Return a text with the result of `page` in place of every path of a page, such as
    docs/flow.md.
    """
    return re.sub(r"\bdocs/([\w/-]+)\.md\b", lambda match: page(match[1]), text)


@cache
def field_docs(config_type: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields by name; none without source code."""
    docs: dict[str, str] = {}
    with suppress(OSError):
        definition: Any = ast.parse(textwrap.dedent(inspect.getsource(config_type))).body[0]
        for pair in pairwise(definition.body):
            match pair:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    docs[name] = inspect.cleandoc(text)
    return docs


def documented(config_type: type[Class]) -> type[Class]:
    """Return a dataclass whose docstring lists its fields with defaults and docstrings, for
    `help()` and notebooks.
    """
    config_type.__doc__ = _ListedFields(inspect.cleandoc(config_type.__doc__ or ""))  # pyright: ignore
    return config_type


class _ListedFields:
    """Docstring of a dataclass that reads the source of the class when it is used.

    Attributes:
        text: the docstring without the list of fields.
    """

    def __init__(self, text: str) -> None:
        self.text = text

    def __get__(self, instance: Any, config_type: Any) -> str:
        lines = [self.text, "", "Fields:"]
        for name, value in vars(config_type()).items():
            default = f"{type(value).__name__}(...)" if is_dataclass(value) else repr(value)
            text = " ".join(field_docs(config_type).get(name, "").split())
            entry = with_pages(f"    {name} = {default}: {text}")
            lines += textwrap.wrap(entry, 120, subsequent_indent=8 * " ", break_on_hyphens=False)
        return "\n".join(lines)
