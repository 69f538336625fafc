"""The layers of the package: a module imports only from its own subpackage and from those before it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import morgs_mi

ROOT = Path(morgs_mi.__file__).parent
SUBPACKAGES = (
    "core",
    "io",
    "render",
    "surfaces",
    "gaussian_integrator",
    "losses",
    "method",
    "fit",
    "codec",
    "config",
    "observation",
    "stream_loop",
    "capture",
    "calibration",
    "synth",
    "recording",
    "recorder",
    "live",
    "importer",
    "playback",
    "evaluate",
    "cluster",
    "export",
    "viewer",
    "demo",
    "cli",
)
# `import morgs_mi` collects names of all subpackages, and `python -m morgs_mi` runs the command line.
ENTRY_POINTS = {ROOT / "__init__.py", ROOT / "__main__.py"}
MODULES = sorted(path for path in ROOT.rglob("*.py") if path not in ENTRY_POINTS)


def subpackage_of(path: Path) -> str:
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
def test_layers__imports_go_down(path):
    own = subpackage_of(path)
    assert own in SUBPACKAGES, f"add {own} to SUBPACKAGES, after all that it imports"
    package = ["morgs_mi", *path.relative_to(ROOT).parent.parts]
    allowed = SUBPACKAGES[: SUBPACKAGES.index(own) + 1]
    names = imported_names(ast.parse(path.read_text(encoding="utf-8")), package)
    inside = [name[1] for name in names if name[0] == "morgs_mi" and len(name) > 1]
    wrong = [target for target in inside if target in SUBPACKAGES and target not in allowed]
    assert not wrong, f"{path.relative_to(ROOT)} imports from {wrong}, which come after `{own}`"
    # A name imported from `morgs_mi` itself would hide its subpackage.
    assert set(inside) <= set(SUBPACKAGES), (
        f"{path.relative_to(ROOT)} imports {set(inside) - set(SUBPACKAGES)} from morgs_mi"
    )
