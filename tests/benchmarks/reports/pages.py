"""Pages of the documentation, which the tests compare with the committed results."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[3]


def page(*names: str) -> str:
    """Return the text of the pages with any of the names, in docs/ or docs/experiments/."""
    paths = [folder / name for folder in (ROOT / "docs", ROOT / "docs/experiments") for name in names]
    texts = [path.read_text(encoding="utf-8") for path in paths if path.is_file()]
    assert texts, f"no page {' or '.join(names)} in docs/ or docs/experiments/"
    return "\n".join(texts)
