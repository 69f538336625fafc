"""Count what a reader of the project decides and steps through, print the counts of each subpackage
and write the sums into CONTRIBUTING.md.

    python tools/weigh.py

decisions   if, loop, clause or condition of a comprehension, each further operand of and/or,
            exception handler, case, lambda, function in a dictionary
iteration   loops, clauses of comprehensions, map, filter
zip         calls of zip
parallel    functions and dataclasses with two or more sequences or mappings side by side
parameters  the most that a function has, without self
nodes       of `ast.walk`, without docstrings
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "CONTRIBUTING.md"
MARKS = "<!-- weight -->\n", "<!-- end of weight -->\n"
COUNTS = ("decisions", "iteration", "zip", "parallel", "parameters", "nodes")
FOLDERS = ("tests", "benchmarks")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
MANY = re.compile(r"(Sequence|list|Mapping|dict|Iterable)\[|tuple\[.*\.\.\.")


def side_by_side(annotations: Iterable[ast.expr | None]) -> int:
    """Return 1 if two or more annotations are of sequences or mappings, else 0."""
    texts = [ast.unparse(annotation) for annotation in annotations if annotation]
    return int(sum(MANY.match(text) is not None for text in texts) > 1)


def counts_of(source: str) -> Counter[str]:
    """Return the counts of a module."""
    tree = ast.parse(source)
    nodes = [*ast.walk(tree)]
    counts = Counter(nodes=len(nodes))
    functions = {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)}
    for node in nodes:
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            counts["nodes"] -= 2
        match node:
            case ast.If() | ast.IfExp() | ast.ExceptHandler() | ast.match_case() | ast.Lambda():
                counts["decisions"] += 1
            case ast.For() | ast.AsyncFor() | ast.While():
                counts.update(decisions=1, iteration=1)
            case ast.comprehension():
                counts.update(decisions=1 + len(node.ifs), iteration=1)
            case ast.BoolOp():
                counts["decisions"] += len(node.values) - 1
            case ast.Dict():
                names = [value.id for value in node.values if isinstance(value, ast.Name)]
                counts["decisions"] += sum(name in functions for name in names)
            case ast.Call(func=ast.Name(id="map" | "filter")):
                counts["iteration"] += 1
            case ast.Call(func=ast.Name(id="zip")):
                counts["zip"] += 1
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                given = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                given = [parameter for parameter in given if parameter.arg not in ("self", "cls")]
                counts["parameters"] = max(counts["parameters"], len(given))
                counts["parallel"] += side_by_side(parameter.annotation for parameter in given)
            case ast.ClassDef() if "dataclass" in " ".join(map(ast.unparse, node.decorator_list)):
                fields = [line.annotation for line in node.body if isinstance(line, ast.AnnAssign)]
                counts["parallel"] += side_by_side(fields)
    return counts


def total(modules: Iterable[Counter[str]]) -> Counter[str]:
    """Return the counts of several modules."""
    modules = [*modules]
    counts = sum(modules, Counter())
    counts["parameters"] = max(module["parameters"] for module in modules)
    return counts


def room_of(path: Path) -> str:
    """Return the subpackage of a module, and the extra of one in `extras`."""
    parts = path.relative_to(ROOT / "morgs_mi").parts[:-1]
    return "/".join(parts[: 1 + (parts[:1] == ("extras",))]) or "its modules"


def module_counts(folder: str) -> dict[Path, Counter[str]]:
    """Return the counts of each module in a folder."""
    paths = sorted((ROOT / folder).rglob("*.py"))
    return {path: counts_of(path.read_text(encoding="utf-8")) for path in paths}


def table(rows: Mapping[str, Counter[str]]) -> str:
    """Return a Markdown table with a row of counts for each name."""
    lines = [f"| | {' | '.join(COUNTS)} |", f"|---|{'---:|' * len(COUNTS)}"]
    for name, counts in rows.items():
        lines.append(f"| {name} | {' | '.join(f'{counts[count]:,}' for count in COUNTS)} |")
    return "\n".join(lines)


def main() -> None:
    """Print a row for each subpackage and folder of modules, and write the rows of the folders and
    the words of the pages.
    """
    package = module_counts("morgs_mi")
    rooms: dict[str, list[Counter[str]]] = {}
    for path, counts in package.items():
        rooms.setdefault(room_of(path), []).append(counts)
    folders = {"morgs_mi": total(package.values())}
    folders |= {name: total(module_counts(name).values()) for name in FOLDERS}
    print(table({name: total(modules) for name, modules in sorted(rooms.items())}))
    pages = [
        page
        for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
        if not {"api", "_build"} & {*page.parts} and page.name != "changelog.md"
    ]
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in pages)
    text = f"{table(folders)}\n\nREADME and pages: {len(pages)} files, {words:,} words.\n"
    print(text)
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    PAGE.write_text(f"{before}{MARKS[0]}\n{text}\n{MARKS[1]}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
