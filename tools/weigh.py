"""Print what the project weighs: syntax nodes and lines of Python, words of pages.

    python tools/weigh.py

A node is one of `ast.walk`; docstrings do not count.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def nodes_of(source: str) -> int:
    """Return the number of syntax nodes of a module without its docstrings."""
    tree = ast.parse(source)
    docstrings = sum(
        isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None
        for node in ast.walk(tree)
    )
    return sum(1 for _ in ast.walk(tree)) - 2 * docstrings


def main() -> None:
    """Print a line for each folder of modules, and one for the pages."""
    for name in ("morgs_mi", "tests", "benchmarks"):
        sources = [file.read_text(encoding="utf-8") for file in (ROOT / name).rglob("*.py")]
        lines = sum(len(source.splitlines()) for source in sources)
        nodes = sum(map(nodes_of, sources))
        print(f"{name:10s} {len(sources):4d} files {lines:7,d} lines {nodes:8,d} nodes")
    pages = [
        file
        for file in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
        if not {"api", "_build"} & {*file.parts} and file.name != "changelog.md"
    ]
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in pages)
    print(f"{'pages':10s} {len(pages):4d} files {words:7,d} words")


if __name__ == "__main__":
    main()
