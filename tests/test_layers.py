"""The layers of the package: a module imports only from its own subpackage and from those before
it.

`extras` is the last one, so nothing outside of it imports it, and no folder of it imports another.
Each enters registries by `platform.extras`.
"""

import ast
from pathlib import Path

import morgs_mi

ROOT = Path(morgs_mi.__file__).parent
SUBPACKAGES = (
    "platform",
    "core",
    "testing",
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
    "extras",
)
# `import morgs_mi` collects names of all subpackages, and `python -m morgs_mi` runs the command
# line.
ENTRY_POINTS = {ROOT / "__init__.py", ROOT / "__main__.py"}
MODULES = sorted(path for path in ROOT.rglob("*.py") if path not in ENTRY_POINTS)


def subpackage_of(path):
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported_names(tree, package):
    """Return the dotted names that the module imports, relative ones resolved against `package`."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = base + (node.module.split(".") if node.module else [])
            names += [[*base, alias.name] for alias in node.names]
    return names


def mistakes(path):
    """Return a line for each of the module's imports from a later subpackage."""
    subpackage = subpackage_of(path)
    place = path.relative_to(ROOT)
    if subpackage not in SUBPACKAGES:
        return [f"{place}: add {subpackage} to SUBPACKAGES, after all that it imports"]
    names = imported_names(
        ast.parse(path.read_text(encoding="utf-8")), ["morgs_mi", *place.parent.parts]
    )
    subpackages = sorted({name[1] for name in names if name[0] == "morgs_mi" and len(name) > 1})
    successors = SUBPACKAGES[SUBPACKAGES.index(subpackage) + 1 :]
    return [
        *(
            f"{place} imports from {name}, which comes after {subpackage}"
            for name in subpackages
            if name in successors
        ),
        # A name imported from `morgs_mi` itself would hide its subpackage.
        *(
            f"{place} imports {name} from morgs_mi itself"
            for name in subpackages
            if name not in SUBPACKAGES
        ),
    ]


def test_layers__imports_go_down():
    assert [mistake for path in MODULES for mistake in mistakes(path)] == []


def test_layers__no_extra_imports_another():
    mistakes = []
    for path in (ROOT / "extras").rglob("*.py"):
        place = path.relative_to(ROOT)
        names = imported_names(
            ast.parse(path.read_text(encoding="utf-8")), ["morgs_mi", *place.parent.parts]
        )
        others = {n[2] for n in names if n[:2] == ["morgs_mi", "extras"]} - {*place.parts[1:2]}
        mistakes += [f"{place} imports from {name}" for name in others]
    assert mistakes == []


def test_layers__only_the_module_that_finds_extras_names_them():
    places = [
        path.relative_to(ROOT)
        for path in MODULES
        if "morgs_mi.extras" in path.read_text(encoding="utf-8")
    ]
    assert [place for place in places if place.parts[0] != "extras"] == [Path("platform/extras.py")]
