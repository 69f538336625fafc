"""The documentation is consistent with the code: names, links, examples, equations and figures."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
import re
from pathlib import Path
from typing import Any

import pytest

import morgs_mi

ROOT = Path(__file__).parents[1]
GENERATED = ("docs/_build/", "docs/_extensions/", "docs/notebooks/", "docs/api/morgs_mi")
PAGES = {
    name: path.read_text(encoding="utf-8")
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if not (name := path.relative_to(ROOT).as_posix()).startswith(GENERATED)
}
ROWS = re.findall(r"^\| (\d+) \| [^|]+ \| (`[\w.]+`(?:, `[\w.]+`)*) \|$", PAGES["docs/architecture.md"], re.MULTILINE)
EQUATIONS = [(number, name) for number, names in ROWS for name in re.findall(r"`([\w.]+)`", names)]
RESULTS = ROOT / "benchmarks/results"


def resolve(path: str) -> Any:
    """Return the module or attribute with a dotted path.

    Raises:
        AttributeError: it does not exist.
    """
    names = path.split(".")
    for count in range(len(names), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(names[:count]))
        except ModuleNotFoundError:
            continue
        for name in names[count:]:
            # A field without a default is no attribute of its dataclass.
            found = None if name in getattr(found, "__dataclass_fields__", ()) else getattr(found, name)
        return found
    raise AttributeError(path)


def exists(path: str) -> bool:
    try:
        resolve(path)
    except AttributeError:
        return False
    return True


def committed(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def test_equation_table__has_every_equation():
    assert [int(number) for number, _ in ROWS] == list(range(1, 14))


@pytest.mark.parametrize(("number", "name"), EQUATIONS)
def test_equation_table__functions_name_their_equation(number, name):
    source = inspect.getsource(resolve(name))
    # "eq. 12", or a list such as "eqs. 3, 8 and 12".
    lists = re.findall(r"\beqs?\. ((?:\d+(?:, | and |-)?)+)", source)
    assert number in {n for found in lists for n in re.findall(r"\d+", found)}, f"{name} does not name eq. {number}"


def test_architecture__lists_every_subpackage():
    listed = re.findall(r"^\| `(\w+)` \|", PAGES["docs/architecture.md"], re.MULTILINE)
    assert sorted(listed) == sorted(m.name for m in pkgutil.iter_modules(morgs_mi.__path__) if m.name != "__main__")


@pytest.mark.parametrize("page", PAGES)
def test_pages__name_only_what_exists(page):
    paths = set(re.findall(r"\bmorgs_mi(?:\.[A-Za-z]\w*)+", PAGES[page]))
    # The page describes how to write these files.
    new = {file.replace("/", ".") for file in re.findall(r"<!-- new (\S+)\.py -->", PAGES[page])}
    assert [path for path in sorted(paths - new) if not exists(path)] == []


@pytest.mark.parametrize("page", PAGES)
def test_pages__link_only_to_what_exists(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", PAGES[page], flags=re.DOTALL))
    local = {target.partition("#")[0] for target in targets if not re.match(r"https?://|mailto:|#", target)}
    assert [target for target in sorted(local) if not (ROOT / page).parent.joinpath(target).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_pages__examples_compile(page):
    # A fragment that is inserted after a line is no module; tests/test_extending.py runs it.
    text = re.sub(r"<!-- after [^\n]*-->\n```python\n.*?```", "", PAGES[page], flags=re.DOTALL)
    for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        compile(example, page, "exec")


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/experiments/")])
def test_experiments__begin_with_date_commit_and_command(page):
    text = PAGES[page].partition("## Summary\n")[2] if page.endswith("index.md") else PAGES[page].partition("\n")[2]
    assert re.match(
        r"\s*\d+ (and \d+ )?[A-Z][a-z]+ \d{4},\s+commits?\s+`[0-9a-f]{7}`.*?\bby\b.*?(python -m benchmarks|make demo)",
        text.strip()[:500],
        re.DOTALL,
    )


def test_experiments__index_lists_every_page():
    listed = re.findall(r"^\| \[[^]]+\]\(([\w-]+\.md)\)", PAGES["docs/experiments/index.md"], re.MULTILINE)
    pages = {path.name for path in (ROOT / "docs/experiments").glob("*.md")}
    assert sorted(listed) == sorted(pages - {"index.md"})


@pytest.mark.parametrize("page", [page for page in PAGES if re.fullmatch(r"docs/[\w-]+\.md", page)])
def test_user_pages__hold_no_measurements(page):
    assert re.findall(r"[^.\n]*\d (?:dB|ms|kB)\b[^.\n]*", PAGES[page]) == []


def test_experiments__quote_the_committed_demo():
    text, report = PAGES["docs/experiments/index.md"], committed("demo")
    for name, title in (("full", "ML + MO + MC"), ("plain", "residuals only")):
        assert demo_row(title, report["comparison"][name]) in text
    first, last = (report["full"]["frames"][k]["psnr"] for k in (0, -1))
    assert re.search(rf"goes\s+from {first:.2f} dB\s+to {last:.2f} dB", text)
    arm = committed("arm")["frames"]
    text = " ".join(text.split())
    assert f"from {arm[0]['psnr']:.2f} dB to {arm[-1]['psnr']:.2f} dB over {len(arm)}" in text


def demo_row(title: str, scores: dict[str, float]) -> str:
    moving, still = scores["motion_error_moving"], scores["motion_error_still"]
    return f"| {title} | {scores['psnr']:.2f} dB | {moving:.2f} px | {still:.2f} px |"


def test_experiments__quote_the_committed_gains():
    clips = committed("method_report")["clips"]

    def scores(preset: str, name: str) -> list[float]:
        rows = [row for clip in clips for row in clip["rows"] if (row["preset"], row["epochs"]) == (preset, 2)]
        return [row["mean"][name] for row in rows if row["best"]]

    def gains(name: str) -> str:
        added = [ours - theirs for ours, theirs in zip(scores("default", name), scores("baseline", name), strict=True)]
        return f"{min(added):.1f} to {max(added):.1f} dB"

    name = "motion_error_moving"
    shares = [ours / theirs for ours, theirs in zip(scores("default", name), scores("baseline", name), strict=True)]
    expected = (
        f"{gains('psnr')} above residuals alone at their best rates ({gains('psnr_moving')} where things move), with "
        f"{min(shares):.1f} to {max(shares):.1f} of their motion error, and PSNR falls by "
        f"{-min(scores('default', 'psnr_slope')):.3f} dB a frame at most"
    )
    assert expected in " ".join(PAGES["docs/experiments/index.md"].split())


@pytest.mark.parametrize("workload", ["W1", "W2", "W2b"])
def test_experiments__quote_the_committed_step_times(workload):
    run = committed(f"render_speed_{workload}")
    plain = f"{run['plain_step_ms']:.0f} ms" if run.get("plain_step_ms") else "not run"
    steps = f"| {run['step_ms']:.0f} ms | {run['optimised_step_ms']:.0f} ms "
    row = f"{steps}| {run['ratio_to_yardstick']:.2f} x | {plain} |"
    assert row in PAGES["docs/experiments/index.md"]


def test_experiments__quote_the_committed_frame_times():
    found = committed("frame_speed")
    big, small = ([found[size]["runs"][f"default, {n} epochs"] for n in (1, 2)] for size in ("n3dv", "small"))
    text = " ".join(PAGES["docs/experiments/index.md"].split())
    assert f"of whose pixels {100 * big[0]['pixels']:.0f} % have to be drawn, one epoch takes" in text
    assert f"takes {big[0]['seconds']:.1f} s a frame and two epochs {big[1]['seconds']:.1f} s" in text
    assert f"640x480 they take {small[0]['seconds']:.1f} s and {small[1]['seconds']:.1f} s" in text
