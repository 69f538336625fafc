"""The documentation is consistent with the code: names, links, examples, equations and figures."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
EXPERIMENTS = {page: text for page, text in PAGES.items() if page.startswith("docs/experiments/")}
GUIDES = {page: text for page, text in PAGES.items() if re.fullmatch(r"docs/[\w-]+\.md", page)}
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


def compiles(example: str) -> bool:
    try:
        compile(example, "example", "exec")
    except SyntaxError:
        return False
    return True


def offenders(pages: dict[str, str], wrong: Callable[[str, str], list]) -> dict[str, list]:
    """Return what is wrong with each page; pages without mistakes are left out."""
    return {page: found for page, text in pages.items() if (found := wrong(page, text))}


def committed(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def test_equation_table__has_every_equation():
    assert [int(number) for number, _ in ROWS] == list(range(1, 14))


def test_equation_table__functions_name_their_equation():
    def named(name: str) -> set[str]:
        # "eq. 12", or a list such as "eqs. 3, 8 and 12".
        lists = re.findall(r"\beqs?\. ((?:\d+(?:, | and |-)?)+)", inspect.getsource(resolve(name)))
        return {number for found in lists for number in re.findall(r"\d+", found)}

    assert [f"{name} does not name eq. {number}" for number, name in EQUATIONS if number not in named(name)] == []


def test_architecture__lists_every_subpackage():
    listed = re.findall(r"^\| `(\w+)` \|", PAGES["docs/architecture.md"], re.MULTILINE)
    assert sorted(listed) == sorted(m.name for m in pkgutil.iter_modules(morgs_mi.__path__) if m.name != "__main__")


def test_pages__name_only_what_exists():
    def missing(_: str, text: str) -> list[str]:
        paths = set(re.findall(r"\bmorgs_mi(?:\.[A-Za-z]\w*)+", text))
        # The page describes how to write these files.
        new = {file.replace("/", ".") for file in re.findall(r"<!-- new (\S+)\.py -->", text)}
        return [path for path in sorted(paths - new) if not exists(path)]

    assert offenders(PAGES, missing) == {}


def test_pages__link_only_to_what_exists():
    def missing(page: str, text: str) -> list[str]:
        targets = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        local = {target.partition("#")[0] for target in targets if not re.match(r"https?://|mailto:|#", target)}
        return [target for target in sorted(local) if not (ROOT / page).parent.joinpath(target).exists()]

    assert offenders(PAGES, missing) == {}


def test_pages__examples_compile():
    def broken(_: str, text: str) -> list[str]:
        # A fragment that is inserted after a line is no module; tests/test_extending.py runs it.
        text = re.sub(r"<!-- after [^\n]*-->\n```python\n.*?```", "", text, flags=re.DOTALL)
        return [example for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if not compiles(example)]

    assert offenders(PAGES, broken) == {}


def test_experiments__begin_with_date_commit_and_command():
    begin = re.compile(
        r"\s*\d+ (and \d+ )?[A-Z][a-z]+ \d{4},\s+commits?\s+`[0-9a-f]{7}`.*?\bby\b.*?(python -m benchmarks|make demo)",
        re.DOTALL,
    )

    def wrong(page: str, text: str) -> list[str]:
        text = text.partition("## Summary\n" if page.endswith("index.md") else "\n")[2].strip()[:500]
        return [] if begin.match(text) else [text]

    assert offenders(EXPERIMENTS, wrong) == {}


def test_experiments__index_lists_every_page():
    listed = re.findall(r"^\| \[[^]]+\]\(([\w-]+\.md)\)", PAGES["docs/experiments/index.md"], re.MULTILINE)
    pages = {path.name for path in (ROOT / "docs/experiments").glob("*.md")}
    assert sorted(listed) == sorted(pages - {"index.md"})


def test_user_pages__hold_no_measurements():
    assert offenders(GUIDES, lambda _, text: re.findall(r"[^.\n]*\d (?:dB|ms|kB)\b[^.\n]*", text)) == {}


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


def test_experiments__quote_the_committed_step_times():
    def row(workload: str) -> str:
        run = committed(f"render_speed_{workload}")
        plain = f"{run['plain_step_ms']:.0f} ms" if run.get("plain_step_ms") else "not run"
        steps = f"| {run['step_ms']:.0f} ms | {run['optimised_step_ms']:.0f} ms "
        return f"{steps}| {run['ratio_to_yardstick']:.2f} x | {plain} |"

    rows = [row(workload) for workload in ("W1", "W2", "W2b")]
    assert [row for row in rows if row not in PAGES["docs/experiments/index.md"]] == []


def test_experiments__quote_the_committed_frame_times():
    found = committed("frame_speed")
    big, small = ([found[size]["runs"][f"default, {n} epochs"] for n in (1, 2)] for size in ("n3dv", "small"))
    text = " ".join(PAGES["docs/experiments/index.md"].split())
    assert f"of whose pixels {100 * big[0]['pixels']:.0f} % have to be drawn, one epoch takes" in text
    assert f"takes {big[0]['seconds']:.1f} s a frame and two epochs {big[1]['seconds']:.1f} s" in text
    assert f"640x480 they take {small[0]['seconds']:.1f} s and {small[1]['seconds']:.1f} s" in text
