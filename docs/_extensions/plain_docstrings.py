"""Reads docstrings as plain text with `code`, indented formulas, lists and Google sections, and no other markup.

Without it, `*`, `|` and a trailing `_` in a formula would be markup, and every docstring would have to escape them.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields|Examples?):$")
CODE = re.compile(r"(`+)((?:(?!\n\s*\n)[^`])+)\1")
MARKUP = re.compile(r"[*|\\]|(?<=\w)_(?!\w)")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("autodoc-process-docstring", convert, priority=400)  # before napoleon
    return {"parallel_read_safe": True}


def convert(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Replace the lines of a docstring by reStructuredText with the same content."""
    result: list[str] = []
    for title, body in sections(lines):
        if title in ("Returns", "Yields"):
            text = escaped("\n".join(dedented(body))).strip().split("\n")
            result += [f":{title.lower()}: {text[0]}", *(f"    {line}" for line in text[1:]), ""]
        elif title in ("Example", "Examples"):
            result += [".. rubric:: Example", "", ".. code-block:: python", "", *body, ""]
        elif title:
            result += [f"{title}:", *escaped("\n".join(body)).split("\n"), ""]
        else:
            result += prose(body)
    lines[:] = result


def sections(lines: list[str]) -> list[tuple[str, list[str]]]:
    """Return (title, lines) of every Google section, "" for the text outside of them."""
    parts: list[tuple[str, list[str]]] = [("", [])]
    for line in lines:
        if match := SECTION.match(line):
            parts.append((match[1], []))
        elif parts[-1][0] and line and not line.startswith(" "):
            parts.append(("", [line]))
        else:
            parts[-1][1].append(line)
    return parts


def prose(lines: list[str]) -> list[str]:
    """Return text whose indented blocks are literal and whose lists are lists."""
    result: list[str] = []
    for block in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        rows = block.split("\n")
        if rows[0].startswith(" "):
            result += ["::", "", *(f"    {row}" for row in rows), ""]
            continue
        for item in re.split(r"\n(?=- )", block):
            first, *rest = escaped(item).split("\n")
            indent = "  " if first.startswith("- ") else ""
            result += [first, *(indent + row.strip() for row in rest), ""]
    return result


def dedented(lines: list[str]) -> list[str]:
    return [line.strip() for line in lines]


def escaped(text: str) -> str:
    """Return text in which `code` is literal and nothing else is markup."""
    result, end = "", 0
    for match in CODE.finditer(text):
        result += MARKUP.sub(r"\\\g<0>", text[end : match.start()])
        inner = match[2].strip()
        # Markup needs no letter beside it.
        before = r"\ " if result[-1:].isalnum() else ""
        after = r"\ " if text[match.end() : match.end() + 1].isalnum() else ""
        result, end = f"{result}{before}``{inner}``{after}", match.end()
    return result + MARKUP.sub(r"\\\g<0>", text[end:])
