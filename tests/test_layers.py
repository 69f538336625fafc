"""The layers of the package: a module imports only from its own subpackage and from those before
it.

`studio` is the last one, so nothing outside of it imports it. It enters registries by the table in
`core.entries`.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import COMMANDS
from morgs_mi.core.entries import STUDIO, studio_entry

ROOT = Path(morgs_mi.__file__).parent
SUBPACKAGES = (
    "core",
    "io",
    "render",
    "surfaces",
    "gaussian_integrator",
    "method",
    "fit",
    "codec",
    "loop",
    "stream_loop",
    "capture",
    "playback",
    "evaluate",
    "runs",
    "cli",
    "studio",
)
# `import morgs_mi` collects names of all subpackages, and `python -m morgs_mi` runs the command
# line.
ENTRY_POINTS = {ROOT / "__init__.py", ROOT / "__main__.py"}
MODULES = sorted(path for path in ROOT.rglob("*.py") if path not in ENTRY_POINTS)


def imported_names(path: Path) -> set[str]:
    """Return the names that a module imports from the package, by their first part."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: expected absolute imports"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("morgs_mi.")}


def mistakes(path: Path) -> list[str]:
    """Return a line for each of the module's imports from a later subpackage."""
    subpackage = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if subpackage not in SUBPACKAGES:
        return [f"{path}: add {subpackage} to SUBPACKAGES, after all that it imports"]
    # A name imported from `morgs_mi` itself would hide its subpackage.
    return [
        f"{path} imports {name}, which is not among the subpackages up to {subpackage}"
        for name in sorted(imported_names(path))
        if name not in SUBPACKAGES[: SUBPACKAGES.index(subpackage) + 1]
    ]


def test_layers__imports_go_down():
    assert [mistake for path in MODULES for mistake in mistakes(path)] == []


def test_layers__only_the_table_of_entries_names_the_studio():
    places = [path for path in MODULES if "morgs_mi.extras" in path.read_text(encoding="utf-8")]
    outside = [path for path in places if not path.is_relative_to(ROOT / "studio")]
    assert outside == [ROOT / "core/entries.py"]


@pytest.mark.parametrize(
    ("registry", "name"),
    [(registry, name) for registry, entries in STUDIO.items() for name in entries],
)
def test_layers__entries_of_the_studio_exist(registry, name):
    assert studio_entry(registry, name) is not None


def test_layers__commands_and_exports_of_the_studio_are_registered():
    assert set(STUDIO["commands"]) <= set(COMMANDS)
    assert set(STUDIO["exports"]) <= set(EXPORTS)
