"""Pages in help and messages: a path in the checkout, otherwise an address."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from morgs_mi.cli.main import main
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform import documentation
from morgs_mi.platform.config import config_toml
from morgs_mi.platform.documentation import documented, page, with_pages

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "morgs_mi").rglob("*.py"))


@dataclass
class Stem:
    """A stem."""


@documented
@dataclass
class Plant:
    """A plant.

    Raises:
        ValueError: never.
    """

    number: float = 1e-5
    """Length
    in px."""
    name: str = "a"
    """Name, see docs/flow.md."""
    stem: Stem = field(default_factory=Stem)
    roots: int = 3
    """Number of roots."""


def test_documented__lists_fields_with_defaults():
    expected = """A plant.

Raises:
    ValueError: never.

Fields:
    number = 1e-05: Length in px.
    name = 'a': Name, see docs/flow.md.
    stem = Stem(...):
    roots = 3: Number of roots."""
    assert Plant.__doc__ == inspect.getdoc(Plant) == Plant().__doc__ == expected


def test_page__is_a_path_in_the_checkout_and_else_an_address(tmp_path, monkeypatch):
    assert page("flow") == "docs/flow.md"
    monkeypatch.setattr(documentation, "CHECKOUT", tmp_path)
    assert (
        with_pages("a, see docs/experiments/field.md.")
        == "a, see https://morgs-mi.readthedocs.io/en/latest/experiments/field.html."
    )
    assert with_pages("mydocs/flow.md, docs/flow.toml") == "mydocs/flow.md, docs/flow.toml"


@pytest.mark.slow
def test_page__gives_every_page_that_a_message_names(tmp_path, monkeypatch, capsys):
    named = []
    for path in SOURCES:
        text = re.sub(r"\n\s*#[^\n]*", "", path.read_text(encoding="utf-8"))
        text = re.sub(r'""".*?"""', "", text, flags=re.DOTALL)  # of options, see below
        named += re.findall(r"docs/[\w/-]+\.md", text)
    assert named == []
    monkeypatch.setattr(documentation, "CHECKOUT", tmp_path)
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    text = capsys.readouterr().out
    assert documentation.DOCUMENTATION in text
    assert "docs/" not in text
    assert "docs/" not in config_toml(StreamConfig())


@pytest.mark.slow
def test_page__exists_for_every_call():
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES)
    names = set(re.findall(r"(?:\bpage\(['\"]|docs/)([\w/-]+)(?:['\"]|\.md)", text))
    assert len(names) > 4
    assert [name for name in sorted(names) if not (ROOT / "docs" / f"{name}.md").is_file()] == []
