"""Check that an assignment binds one thing, and that tests patch public names.

`python tools/check_dialect.py FOLDER...` prints a sentence for each violation, and exits with 1 if
there is one.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path


def is_parallel(node: ast.Assign) -> bool:
    """Return whether an assignment gives several targets a value each; one that only swaps names
    does not count.
    """
    places = [target for target in node.targets if isinstance(target, ast.Tuple | ast.List)]
    if not places or not isinstance(node.value, ast.Tuple | ast.List):
        return False
    targets = {ast.unparse(target) for target in places[0].elts}
    is_swap = all(isinstance(target, ast.Name) for target in places[0].elts)
    return not (is_swap and targets == {ast.unparse(value) for value in node.value.elts})


def patches_private_name(node: ast.Call) -> bool:
    """Return whether a call is `setattr` of pytest's `monkeypatch` with a private name."""
    is_patch = isinstance(node.func, ast.Attribute) and node.func.attr == "setattr"
    names = [
        arg.value
        for arg in node.args[:2]
        if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
    ]
    last_parts = [name.rpartition(".")[2] for name in names]
    return is_patch and any(name.startswith("_") and not name.endswith("__") for name in last_parts)


def violations(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the sentence of each violation in a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and patches_private_name(node):
            yield node.lineno, "expected a public name to patch, got a private one; make it public."
        if isinstance(node, ast.Assign) and is_parallel(node):
            yield node.lineno, "expected an assignment of one value, got several; give each a line."
        elif isinstance(node, ast.Assign) and len(node.targets) > 1 and node in tree.body:
            yield (
                node.lineno,
                "expected an assignment of one constant, got several; give each a line.",
            )


def modules(place: Path) -> list[Path]:
    """Return a module, or all modules in a folder."""
    return [place] if place.is_file() else list(place.rglob("*.py"))


def check(places: Sequence[str]) -> list[str]:
    """Return a line for each violation in modules and folders of modules, in the order of files
    and lines.
    """
    lines = []
    paths = sorted(path for place in places for path in modules(Path(place)))
    if not paths:
        return [f"expected modules to check, found none in {' '.join(places) or 'no arguments'}."]
    for path in paths:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        rows = sorted(violations(tree))
        lines += [f"{path}:{number}: {sentence}" for number, sentence in rows]
    return lines


if __name__ == "__main__":
    sys.exit("\n".join(check(sys.argv[1:])) or 0)
