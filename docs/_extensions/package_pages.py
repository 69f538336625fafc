"""Writes the pages that follow from the repository: api/ from the package and its plugins,
notebooks/ from the notebooks.
"""

from __future__ import annotations

import ast
import pkgutil
import re
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType
from typing import Any

from docutils.nodes import Element
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer

import morgs_mi

# Modules of the integrators, which can be imported once a variant is set.
PER_VARIANT = ("morgs_mi.surfaces.gaussian_splat", "morgs_mi.extras.light.splat_path")
NOTEBOOK = re.compile(r"\]\((?:\.\./)+notebooks/(\w+)\.ipynb\)")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("config-inited", lambda app, config: write_pages(Path(app.srcdir)))
    app.connect("source-read", link_notebooks)
    app.connect("source-read", list_packages)
    app.connect("missing-reference", leave_internal_names)
    return {"parallel_read_safe": True}


def write_pages(docs: Path) -> None:
    """Write a page per module or subpackage of `morgs_mi` and per plugin to api/, and copy the
    notebooks.
    """
    pages = {"morgs_mi": front_door()}
    for child in pkgutil.iter_modules(morgs_mi.__path__):
        if child.name != "__main__":
            name = f"morgs_mi.{child.name}"
            pages[name] = "\n".join(
                [f"# {name}\n", *(chapter(module, name) for module in modules_of(name))]
            )
    for module in PER_VARIANT:
        pages[f"plugin_{name_of(module)}"] = plugin_page(module)
    for old in (docs / "api").glob("*_*.md"):
        if old.stem not in pages:
            old.unlink()
    for name, text in pages.items():
        write_if_changed(docs / "api" / f"{name}.md", text.encode())
    for notebook in (docs.parent / "notebooks").glob("*.ipynb"):
        # From the copy, docs/ is one level up, as in the repository: its pages are found without
        # the folder's name.
        write_if_changed(
            docs / "notebooks" / notebook.name,
            notebook.read_bytes().replace(b"](../docs/", b"](../"),
        )


def modules_of(name: str) -> list[str]:
    """Return a module and, of a subpackage, all modules in it, by name."""
    package = import_module(name)
    inside = pkgutil.walk_packages(getattr(package, "__path__", []), f"{name}.")
    return [name, *sorted(module.name for module in inside if module.name not in PER_VARIANT)]


def chapter(module: str, page: str) -> str:
    heading = "" if module == page else f"## {module.removeprefix(page + '.')}\n\n"
    return f"{heading}```{{eval-rst}}\n.. automodule:: {module}\n```\n"


def name_of(module: str) -> str:
    return module.rpartition(".")[2]


def plugin_page(module: str) -> str:
    """Return the page of an integrator, from the docstring of its class in Mitsuba's markup."""
    name = name_of(module)
    title, *blocks = re.split(r"\n\s*\n", plugin_doc(module))
    rows = [block for block in blocks if block.lstrip().startswith("* -")]
    prose = [block for block in blocks if not block.startswith((" ", ".."))]
    kind = title.replace(f" (:monosp:`{name}`)", "")
    lines = [f"# {name}", "", kind, "", f'    {{"type": "{name}"}}', ""]
    lines += ["| parameter | type | description |", "|---|---|---|"]
    for row in rows:
        parameter, types, text = (
            " ".join(cell.split()) for cell in re.split(r"(?m)^ +(?:\* )?- ", row)[1:]
        )
        lines.append(f"| `{parameter}` | {types.replace('|', '')} | {text} |")
    return "\n".join([*lines, "", "\n\n".join(prose)]) + "\n"


def plugin_doc(module: str) -> str:
    """Return the docstring of the integrator in a module, without importing it."""
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    body = ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body
    docs = [ast.get_docstring(node) or "" for node in body if isinstance(node, ast.ClassDef)]
    return next(doc for doc in docs if f":monosp:`{name_of(module)}`" in doc)


def front_door() -> str:
    """Return the page of the names of `import morgs_mi`, each linked to its description."""
    lines = ["# morgs_mi", "", "The names that `import morgs_mi` provides:", ""]
    for name in sorted(morgs_mi.__all__):
        path, doc = description(name)
        lines.append(f"- {{py:obj}}`morgs_mi.{name} <{path}>`: {first_paragraph(doc)}")
    return "\n".join(lines) + "\n"


def description(name: str) -> tuple[str, str]:
    """Return the dotted path at which a name of `morgs_mi` is defined, and its docstring."""
    target = getattr(morgs_mi, name)
    if hasattr(target, "__qualname__"):
        return f"{target.__module__}.{target.__qualname__}", target.__doc__ or ""
    # A constant does not name its module: it is the one that describes it.
    packages = (module for module in sorted(sys.modules) if module.startswith("morgs_mi."))
    module = next(
        m for m in packages if ("", name) in ModuleAnalyzer.for_module(m).find_attr_docs()
    )
    return f"{module}.{name}", "\n".join(
        ModuleAnalyzer.for_module(module).find_attr_docs()["", name]
    )


def write_if_changed(path: Path, content: bytes) -> None:
    """Write a file unless it has this content already, so that Sphinx rereads only what has
    changed.
    """
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_bytes() != content:
        path.write_bytes(content)


def link_notebooks(app: Sphinx, name: str, source: list[str]) -> None:
    """Let links to notebooks/, which lies beside docs/, lead to the copies."""
    source[0] = NOTEBOOK.sub(r"](/notebooks/\1.ipynb)", source[0])


def list_packages(app: Sphinx, name: str, source: list[str]) -> None:
    """Let the comment `<!-- packages -->` be a line per module or subpackage of `morgs_mi`, and
    `<!-- plugins -->` a line per plugin.
    """
    names = sorted(path.stem for path in (Path(app.srcdir) / "api").glob("morgs_mi*.md"))
    docs = [import_module(name).__doc__ or "" for name in names]
    pairs = zip(names, docs, strict=True)
    lines = [f"- [`{name}`]({name}.md): {first_paragraph(doc)}" for name, doc in pairs]
    source[0] = source[0].replace("<!-- packages -->", "\n".join(lines))
    plugins = [f"- [`{name_of(module)}`](plugin_{name_of(module)}.md)" for module in PER_VARIANT]
    source[0] = source[0].replace("<!-- plugins -->", "\n".join(plugins))


def first_paragraph(doc: str) -> str:
    """Return the first paragraph of a docstring as one line."""
    return " ".join(doc.strip().split("\n\n")[0].split())


def leave_internal_names(
    app: Sphinx, env: BuildEnvironment, node: Element, content: Element
) -> Element | None:
    """Leave a type in a signature without a link if it has no description: it is private, or a
    variable.
    """
    module, _, name = node.get("reftarget", "").rpartition(".")
    target = getattr(sys.modules.get(module), name, None)
    is_described = (
        isinstance(target, type | FunctionType) and target.__module__ == module and target.__doc__
    )
    is_internal = module.startswith("morgs_mi") and (name.startswith("_") or not is_described)
    return content if is_internal else None
