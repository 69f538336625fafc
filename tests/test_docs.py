"""The documentation is consistent with the code: names, links, examples, equations and figures."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import morgs_mi

ROOT = Path(__file__).parents[1]
GENERATED = (
    "docs/_build/",
    "docs/_extensions/",
    "docs/notebooks/",
    "docs/api/morgs_mi",
    "docs/api/plugin_",
)
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


def resolve(path):
    """Return the module or attribute with a dotted path.

    Raises:
        AttributeError: it does not exist.
    """
    owner, _, name = path.rpartition(".")
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        value = resolve(owner)
    # A field without a default is no attribute of its dataclass.
    return None if name in getattr(value, "__dataclass_fields__", ()) else getattr(value, name)


def exists(path):
    try:
        resolve(path)
    except AttributeError:
        return False
    return True


def offenders(pages, wrong):
    """Return the mistakes of each page; pages without mistakes are left out."""
    return {page: problems for page, text in pages.items() if (problems := wrong(page, text))}


def test_equation_table__has_every_equation():
    assert [int(number) for number, _ in ROWS] == list(range(1, 14))


def test_equation_table__functions_name_their_equation():
    for number, name in EQUATIONS:
        # "eq. 12", or a list such as "eqs. 3, 8 and 12".
        source = inspect.getsource(resolve(name))
        lists = re.findall(r"\beqs?\. ((?:\d+(?:, | and |-)?)+)", source)
        assert number in re.findall(r"\d+", " ".join(lists)), f"{name} does not name eq. {number}"


def test_architecture__lists_every_subpackage():
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", PAGES["docs/architecture.md"], re.MULTILINE)
    package = Path(morgs_mi.__file__).parent
    folders = [str(package), str(package / "extras")]
    names = {module.name for module in pkgutil.iter_modules(folders)}
    assert set(re.findall(r"\w+", " ".join(rows))) == names - {"__main__", "extras"}


def test_pages__name_only_what_exists():
    def missing(_, text):
        paths = set(re.findall(r"\bmorgs_mi(?:\.[A-Za-z]\w*)+", text))
        return [path for path in sorted(paths) if not exists(path)]

    assert offenders(PAGES, missing) == {}


def test_pages__link_only_to_what_exists():
    def missing(page, text):
        prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        targets = set(re.findall(r"\]\((?!https?://|mailto:|#)([^)\s#]+)", prose))
        folder = (ROOT / page).parent
        return [target for target in sorted(targets) if not (folder / target).exists()]

    assert offenders(PAGES, missing) == {}


def test_pages__examples_compile():
    for text in PAGES.values():
        # A fragment that is inserted after a line is no module; tests/test_extending.py runs it.
        modules = re.sub(r"<!-- after [^\n]*-->\n```python\n.*?```", "", text, flags=re.DOTALL)
        for example in re.findall(r"```python\n(.*?)```", modules, re.DOTALL):
            compile(example, "example", "exec")


def test_user_pages__hold_no_measurements():
    assert (
        offenders(GUIDES, lambda _, text: re.findall(r"[^.\n]*\d (?:dB|ms|kB)\b[^.\n]*", text))
        == {}
    )
