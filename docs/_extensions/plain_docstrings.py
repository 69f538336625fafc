"""Reads Google docstrings as plain text with `code`, indented formulas and lists, and no other
markup.

Napoleon passes texts on as reStructuredText. There `*`, `|` and a trailing `_` in a formula are
markup, a line that begins with "N." is a list, and the text before a colon is a type; every
docstring would have to avoid that.
"""

from __future__ import annotations

import re
import textwrap
from typing import Any

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields|Examples?):$")
FIELDS = {"Args": ":param {}:", "Attributes": "- ``{}``:", "Raises": ":raises {}:"}
CODE = re.compile(r"(`+)((?:(?!\n\s*\n)[^`])+)\1")
MARKUP = re.compile(r"[*|\\]|(?<=\w)_(?!\w)|(?m:^\s*\w{1,3}(?=[.)](?:\s|$)))")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("autodoc-process-docstring", convert)
    return {"parallel_read_safe": True}


def convert(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Replace the lines of a docstring by reStructuredText with the same content."""
    if "Fields:" in lines:  # the fields of a config have entries of their own
        del lines[lines.index("Fields:") :]
    result: list[str] = []
    for title, body in sections(lines):
        if title in FIELDS:
            entries = [entry(FIELDS[title], item) for item in items(body)]
            result += (
                [":Attributes:", *indented(entries), ""]
                if title == "Attributes"
                else [*entries, ""]
            )
        elif title.startswith("Example"):
            result += [".. rubric:: Example", "", ".. code-block:: python", "", *body, ""]
        elif title:
            result += [entry(f":{title.lower()}:", "\n".join(body)), ""]
        else:
            result += prose(body)
    lines[:] = "\n".join(result).split("\n")


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


def items(lines: list[str]) -> list[str]:
    """Return the items of a section, which begin where the indentation is least."""
    text = textwrap.dedent("\n".join(lines)).strip()
    return re.split(r"\n(?=[^\s])", text) if text else []


def entry(field: str, item: str) -> str:
    """Return one field of a field list, from "name: text" if the field has a name."""
    name, colon, text = item.partition(":") if "{}" in field else ("", "", item)
    words = " ".join((text if colon or not name else name).split())
    return f"{field.format(name.strip())} {escaped(words)}"


def prose(lines: list[str]) -> list[str]:
    """Return text whose indented blocks are literal and whose lists are lists."""
    result: list[str] = []
    for block in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        if block.startswith(" "):
            result += ["::", "", *indented(block.split("\n")), ""]
            continue
        for item in re.split(r"\n(?=- )", block):
            bullet = "- " if item.startswith("- ") else ""
            result += [bullet + escaped(" ".join(item.removeprefix(bullet).split())), ""]
    return result


def indented(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def escaped(text: str) -> str:
    """Return text in which `code` is literal and nothing else is markup."""
    result, end = "", 0
    for match in CODE.finditer(text):
        result += MARKUP.sub(r"\\\g<0>", text[end : match.start()])
        # Markup needs no letter beside it.
        before = r"\ " if result[-1:].isalnum() else ""
        after = r"\ " if text[match.end() : match.end() + 1].isalnum() else ""
        result, end = f"{result}{before}``{match[2].strip()}``{after}", match.end()
    return result + MARKUP.sub(r"\\\g<0>", text[end:])
