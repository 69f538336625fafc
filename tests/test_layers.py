"""A module imports only from its own room and from rooms to its left."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import morgs_mi

ROOT = Path(morgs_mi.__file__).parent
ROOMS = (
    "core",
    "io",
    "render",
    "gaussian_integrator",
    "losses",
    "method",
    "fit",
    "codec",
    "config",
    "stream_loop",
    "capture",
    "calibration",
    "synth",
    "recorder",
    "playback",
    "evaluate",
    "export",
    "viewer",
    "demo",
    "cli",
)
# The package's front door gathers what the rooms offer, `python -m morgs_mi` opens the command line.
DOORS = {ROOT / "__init__.py", ROOT / "__main__.py"}
MODULES = sorted(path for path in ROOT.rglob("*.py") if path not in DOORS)


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported_names(tree: ast.AST, package: list[str]) -> list[list[str]]:
    """Return the dotted names that the module imports, relative ones resolved against `package`."""
    names: list[list[str]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = base + (node.module.split(".") if node.module else [])
            names += [[*base, alias.name] for alias in node.names]
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_left(path):
    room = room_of(path)
    assert room in ROOMS, f"{room} is not a room: add it to ROOMS in the order of the data's flow"
    package = ["morgs_mi", *path.relative_to(ROOT).parent.parts]
    allowed = ROOMS[: ROOMS.index(room) + 1]
    names = imported_names(ast.parse(path.read_text(encoding="utf-8")), package)
    inside = [name[1] for name in names if name[0] == "morgs_mi" and len(name) > 1]
    wrong = [target for target in inside if target in ROOMS and target not in allowed]
    assert not wrong, f"{path.relative_to(ROOT)} imports from {wrong}, right of `{room}`"
    # Names that the front door gathers would hide which room they come from.
    assert set(inside) <= set(ROOMS), f"{path.relative_to(ROOT)} imports {set(inside) - set(ROOMS)} from morgs_mi"
