"""Pages of experiments: their tables, claims and figures agree with the committed results."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.pages.__main__ import PAGES, with_tables
from benchmarks.pages.plots import PLOTS
from benchmarks.pages.results import committed
from benchmarks.pages.tables import TABLES

TEXTS = {path.name: path.read_text(encoding="utf-8") for path in PAGES.glob("*.md")}
WORDS = {name: " ".join(text.split()) for name, text in TEXTS.items()}
CLAIMS = re.split(
    r"^### ", TEXTS["index.md"].partition("## What is not shown")[0], flags=re.MULTILINE
)[1:]
# "22 November 2026, commit `c41387b`", also of several days or commits.
SETUP = r"\d+ (?:and \d+ )?[A-Z][a-z]+ \d{4},\s+commits?\s+`[0-9a-f]{7}`"


def missing(page: str, figures: Iterable[str]) -> list[str]:
    """Return the sentences that a page does not have."""
    return [text for text in figures if text not in WORDS[page]]


def test_with_tables__leaves_every_page_as_it_is():
    assert [name for name, text in TEXTS.items() if with_tables(text) != text] == []


def test_tables__are_on_one_page_each():
    assert sorted(re.findall(r"<!-- table: (\w+) -->", "".join(TEXTS.values()))) == sorted(TABLES)


def test_plots__are_drawn_and_shown(tmp_path: Path):
    for name, plot in PLOTS.items():
        assert f"({name}.png)" in TEXTS["index.md"]
        plot().savefig(tmp_path / f"{name}.png")


def test_claims__have_a_table_or_figure_a_command_and_committed_results():
    assert len(CLAIMS) == 10
    result = r"\]\(\.\./\.\./benchmarks/results/\w+\.json\)"
    parts = (
        r"<!-- table: |!\[",
        r"`(?:make demo|python\s+-m\s+(?:benchmarks|tests)\.[^`]+)`",
        SETUP,
        result,
    )
    assert [
        (claim.partition("\n")[0], part)
        for claim in CLAIMS
        for part in parts
        if not re.search(part, claim)
    ] == []


def test_commands__follow_date_and_commit():
    for name, text in TEXTS.items():
        commands = len(re.findall(r"^\n    python -m ", text, re.MULTILINE))
        setups = re.findall(
            rf"^{SETUP}[^.\n]*(?:\n[^.\n]+)?\bby\n\n    python -m ", text, re.MULTILINE
        )
        assert len(setups) == commands, name


def test_index__lists_every_page():
    listed = re.findall(r"\[[^]]+\]\(([\w-]+\.md)\)", TEXTS["index.md"].partition("## Pages")[2])
    assert sorted(listed) == sorted(TEXTS.keys() - {"index.md"})


def test_index__quotes_the_demo():
    frames = committed("demo")["full"]["frames"]
    arm = committed("arm")["frames"]
    assert not missing(
        "index.md",
        [
            f"PSNR goes from {frames[0]['psnr']:.2f} dB to {frames[-1]['psnr']:.2f} dB.",
            f"from {arm[0]['psnr']:.2f} dB to {arm[-1]['psnr']:.2f} dB over {len(arm)} frames",
        ],
    )


def test_index__quotes_the_gains():
    clips = committed("method_report")["clips"]

    def scores(preset: str, name: str) -> np.ndarray:
        rows = [
            row
            for clip in clips
            for row in clip["rows"]
            if (row["preset"], row["epochs"]) == (preset, 2)
        ]
        return np.array([row["mean"][name] for row in rows if row["best"]])

    def gains(name: str) -> str:
        added = scores("default", name) - scores("baseline", name)
        return f"{min(added):.1f} to {max(added):.1f} dB"

    shares = scores("default", "motion_error_moving") / scores("baseline", "motion_error_moving")
    assert not missing(
        "index.md",
        [
            f"{gains('psnr')} above residuals alone at their best rates ({gains('psnr_moving')} "
            f"where things move), with {min(shares):.1f} to {max(shares):.1f} of their motion "
            f"error, and PSNR falls by {-min(scores('default', 'psnr_slope')):.3f} dB a frame at "
            "most"
        ],
    )


def test_index__quotes_the_field_and_the_drift():
    cells = committed("field")["cells"].values()
    methods = [name for name in next(iter(cells)) if name.endswith("/8") and "default" not in name]

    def mean(method: str, score: str) -> float:
        return float(np.mean([cell[method][score] for cell in cells]))

    jaccard = "Dynamic 3D Gaussians average_jaccard"
    (drift,) = (fit for fit in committed("drift")["fits"] if fit["clip"] == "random-15")
    assert not missing(
        "index.md",
        [
            f"has {mean('default/8', 'psnr_moving'):.1f} dB where things move, the next method "
            f"{max(mean(method, 'psnr_moving') for method in methods):.1f} dB",
            f"AJ is {100 * mean('default/8', jaccard):.1f} % for the default and "
            f"{100 * mean('default + rigidity/8', jaccard):.1f} % with their terms added",
            f"Random scene 15 has {np.mean(drift['psnr']):.2f} dB, with a slope of "
            f"{drift['slope_moving_db_a_frame']:+.2f} dB a frame",
        ],
    )


def test_index__quotes_the_clocks():
    fits = committed("timing")["fits"]
    names = "synchronised", "recorded", "aligned"
    means = [np.mean([fit[f"{name}_moving"] for fit in fits]) for name in names]
    assert not missing(
        "index.md", ["PSNR is {:.1f}, {:.1f} and {:.1f} dB in the mean.".format(*means)]
    )


def test_index__quotes_the_renderer_and_the_fuzzers():
    runs = {name: committed(f"render_speed_{name}") for name in ("W1", "W2", "W2b")}
    ratios = [run["ratio_to_yardstick"] for run in runs.values()]
    plain = [runs[name]["plain_step_ms"] for name in ("W1", "W2b")]
    fuzzers = committed("fuzz")["fuzzers"]
    assert not missing(
        "index.md",
        [
            f"{min(ratios):.2f} to {max(ratios):.2f} of the time of tuned C++",
            f"takes {plain[0]:.0f} ms in the first row and {plain[1]:.0f} ms in the second",
            "a step of the second row takes "
            f"{100 * committed('render_speed_W2b')['tenth_share']:.0f} % of the time",
            f"in {fuzzers['damage']['streams']:,} damaged streams and "
            f"{fuzzers['bytes']['streams']:,} with changed",
        ],
    )


def test_renderer_page__quotes_the_times_of_other_settings():
    rows = {
        (row["knob"], row["value"]): row["step_ratio"]
        for row in committed("renderer_report")["rows"]
    }
    assert not missing(
        "renderer.md",
        [
            f"Blocks of 4x4 and 8x8 pixels take {rows['block', '4x4']:.2f} and "
            f"{rows['block', '8x8']:.2f} of the time, `reproducible` takes "
            f"{rows['reproducible', 'true']:.2f}"
        ],
    )


def test_index__quotes_the_unseen_scenes_without_seed_4():
    fits = [fit for fit in committed("random_scenes")["fits"] if fit["seed"] != 4]
    psnr, moving = (np.mean([fit[name] for fit in fits]) for name in ("psnr", "psnr_moving"))
    assert not missing(
        "index.md", [f"the means are {psnr:.2f} dB and {moving:.2f} dB where things move"]
    )


def test_captures_page__quotes_the_recording():
    walk4 = committed("walk4")
    assert not missing(
        "captures.md",
        [
            f"{walk4['psnr']['first']:.2f} dB in the first frame and {walk4['psnr']['last']:.2f} "
            "dB in the last",
            f"{walk4['psnr_moving']:.2f} dB where things move",
            f"takes {walk4['seconds']['per_later_frame']:.1f} s and "
            f"{walk4['bytes']['per_residual'] / 1000:.0f} kB",
        ],
    )
