"""Pages in help and messages: a path in the checkout, otherwise an address."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from morgs_mi.core import documentation
from morgs_mi.core.documentation import page, with_pages
from morgs_mi.loop.stream_config import StreamConfig, config_toml

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "morgs_mi").rglob("*.py"))


def test_page__is_a_path_in_the_checkout() -> None:
    assert page("flow") == "docs/flow.md"


def test_page__is_an_address_without_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documentation, "_CHECKOUT", tmp_path)
    assert page("experiments/field") == "https://morgs-mi.readthedocs.io/en/latest/experiments/field.html"
    assert with_pages("a, see docs/flow.md.") == "a, see https://morgs-mi.readthedocs.io/en/latest/flow.html."
    assert with_pages("mydocs/flow.md, docs/flow.toml") == "mydocs/flow.md, docs/flow.toml"


def messages(path: Path) -> list[str]:
    """Return the texts of a module but its docstrings, which are help in the commands alone."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    hidden = {id(node.value) for node in nodes if isinstance(node, ast.Expr) and path.parent.name != "cli"}
    texts = [node for node in nodes if isinstance(node, ast.Constant) and id(node) not in hidden]
    return [node.value for node in texts if isinstance(node.value, str)]


def test_page__gives_every_page_that_a_message_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = {str(path): text for path in SOURCES for text in messages(path) if re.search(r"docs/[\w/-]+\.md", text)}
    assert named == {}
    monkeypatch.setattr(documentation, "_CHECKOUT", tmp_path)
    assert "docs/" not in config_toml(StreamConfig())


def test_page__exists_for_every_call() -> None:
    calls = [
        node.args[0]
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "page"
    ]
    names = {arg.value for arg in calls if isinstance(arg, ast.Constant)}
    assert len(names) > 4
    assert [name for name in sorted(names) if not (ROOT / "docs" / f"{name}.md").is_file()] == []
