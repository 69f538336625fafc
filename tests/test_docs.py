"""The documentation is consistent with the code: names, links, examples, equations and figures."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import morgs_mi
import morgs_mi.studio

ROOT = Path(__file__).parents[1]
GENERATED = ("docs/_build/", "docs/_extensions/", "docs/notebooks/", "docs/api/morgs_mi")
PAGES = {
    name: path.read_text(encoding="utf-8")
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if not (name := path.relative_to(ROOT).as_posix()).startswith(GENERATED)
}
ROWS = re.findall(
    r"^\| (\d+) \| [^|]+ \| (`[\w.]+`(?:, `[\w.]+`)*) \|$",
    PAGES["docs/architecture.md"],
    re.MULTILINE,
)
EQUATIONS = [(number, name) for number, names in ROWS for name in re.findall(r"`([\w.]+)`", names)]
GUIDES = {page: text for page, text in PAGES.items() if re.fullmatch(r"docs/[\w-]+\.md", page)}


def resolve(path: str) -> Any:
    """Return the module or attribute with a dotted path.

    Raises:
        AttributeError: it does not exist.
    """
    names = path.split(".")
    for count in range(len(names), 0, -1):
        try:
            value: Any = importlib.import_module(".".join(names[:count]))
        except ModuleNotFoundError:
            continue
        for name in names[count:]:
            # A field without a default is no attribute of its dataclass.
            value = (
                None if name in getattr(value, "__dataclass_fields__", ()) else getattr(value, name)
            )
        return value
    raise AttributeError(path)


def exists(path: str) -> bool:
    try:
        resolve(path)
    except AttributeError:
        return False
    return True


def compiles(example: str) -> bool:
    try:
        compile(example, "example", "exec")
    except SyntaxError:
        return False
    return True


def offenders(pages: dict[str, str], wrong: Callable[[str, str], list]) -> dict[str, list]:
    """Return the mistakes of each page; pages without mistakes are left out."""
    return {page: problems for page, text in pages.items() if (problems := wrong(page, text))}


def test_equation_table__has_every_equation():
    assert [int(number) for number, _ in ROWS] == list(range(1, 14))


def test_equation_table__functions_name_their_equation():
    def named(name: str) -> set[str]:
        # "eq. 12", or a list such as "eqs. 3, 8 and 12".
        lists = re.findall(r"\beqs?\. ((?:\d+(?:, | and |-)?)+)", inspect.getsource(resolve(name)))
        return {number for text in lists for number in re.findall(r"\d+", text)}

    assert [
        f"{name} does not name eq. {number}"
        for number, name in EQUATIONS
        if number not in named(name)
    ] == []


def test_architecture__lists_every_subpackage():
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", PAGES["docs/architecture.md"], re.MULTILINE)
    listed = {name for row in rows for name in re.findall(r"\w+", row)}
    modules = [
        *pkgutil.iter_modules(morgs_mi.__path__),
        *pkgutil.iter_modules(morgs_mi.studio.__path__),
    ]
    assert listed == {module.name for module in modules} - {"__main__"}


def test_pages__name_only_what_exists():
    def missing(_: str, text: str) -> list[str]:
        paths = set(re.findall(r"\bmorgs_mi(?:\.[A-Za-z]\w*)+", text))
        return [path for path in sorted(paths) if not exists(path)]

    assert offenders(PAGES, missing) == {}


def test_pages__link_only_to_what_exists():
    def missing(page: str, text: str) -> list[str]:
        targets = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        local = {
            target.partition("#")[0]
            for target in targets
            if not re.match(r"https?://|mailto:|#", target)
        }
        return [
            target for target in sorted(local) if not (ROOT / page).parent.joinpath(target).exists()
        ]

    assert offenders(PAGES, missing) == {}


def test_pages__examples_compile():
    def broken(_: str, text: str) -> list[str]:
        # A fragment that is inserted after a line is no module; tests/test_extending.py runs it.
        text = re.sub(r"<!-- after [^\n]*-->\n```python\n.*?```", "", text, flags=re.DOTALL)
        return [
            example
            for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
            if not compiles(example)
        ]

    assert offenders(PAGES, broken) == {}


def test_user_pages__hold_no_measurements():
    assert (
        offenders(GUIDES, lambda _, text: re.findall(r"[^.\n]*\d (?:dB|ms|kB)\b[^.\n]*", text))
        == {}
    )
