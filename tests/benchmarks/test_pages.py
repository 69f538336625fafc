"""Pages of experiments: tables, claims, commands and figures agree with the committed results."""

import re
import shlex
from importlib import import_module
from importlib.util import find_spec

import numpy as np
import tyro

from benchmarks.pages.__main__ import PAGES, with_tables
from benchmarks.pages.plots import PLOTS
from benchmarks.pages.results import RESULTS, committed
from benchmarks.pages.tables import TABLES
from benchmarks.reports.plots import grouped, span

TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in PAGES.glob("*.md")}
EVERYTHING = "\n".join(TEXTS.values())
# Modules that only the history has.
HISTORY = re.findall(r"up to commit `[0-9a-f]{7}`:((?:\s+`[\w.]+`[,;.])+)", TEXTS["index"])
ENDED = set(re.findall(r"`([\w.]+)`", " ".join(HISTORY)))
# "22 November 2026, commit `c41387b`", also of several days or commits.
SETUP = r"\d+ (?:and \d+ )?[A-Z][a-z]+ \d{4},\s+commits?\s+`[0-9a-f]{7}`"
RESULT = r"\]\(\.\./\.\./benchmarks/results/(\w+\.json)\)"
MOTION = "motion_error_moving"


def test_with_tables__leaves_every_page_as_it_is():
    assert [name for name, text in TEXTS.items() if with_tables(text) != text] == []
    assert sorted(re.findall(r"<!-- table: (\w+) -->", EVERYTHING)) == sorted(TABLES)


def test_pages__show_every_plot_and_the_index_lists_them(tmp_path):
    for name, plot in PLOTS.items():
        assert f"({name}.png)" in EVERYTHING
        plot().savefig(tmp_path / f"{name}.png")
    pages = re.findall(r"^- \[[^]]+\]\(([\w-]+)\.md\)", TEXTS["index"], re.MULTILINE)
    assert sorted(pages) == sorted(TEXTS.keys() - {"index"})


def section(page, anchor):
    """Return the section of a page that has a heading, with the sections inside."""
    heading = rf"^(?:#+ )?{anchor.replace('-', '.')}$"
    sections = TEXTS[page].split("\n## ")
    (text,) = (text for text in sections if re.search(heading, text, re.MULTILINE | re.IGNORECASE))
    return text


def test_claims__have_a_table_or_figure_a_command_and_committed_results():
    command = r"(?:`| {4})(?:make demo|python\s+-m\s+(?:benchmarks|tests)\.[^`]+)"
    claims = re.findall(r"\(([\w-]+)\.md#([\w-]+)\)", TEXTS["index"])
    assert len(claims) == 14
    for claim in claims:
        for part in (r"\n\|---|!\[", command, SETUP, RESULT):
            assert re.search(part, section(*claim)), (claim, part)
    assert set(re.findall(RESULT, EVERYTHING)) == {path.name for path in RESULTS.iterdir()}


def test_commands__follow_date_and_commit_and_have_options_that_exist():
    for name, text in TEXTS.items():
        setups = rf"^{SETUP}[^.\n]*(?:\n[^.\n]+)?\bby\n\n    python -m "
        commands = re.findall(r"^\n    python -m ", text, re.MULTILINE)
        assert len(re.findall(setups, text, re.MULTILINE)) == len(commands), name
    block = r"^ {4}.*python -m (benchmarks\.(?:reports|speed)\S*.*)$"
    text = EVERYTHING.replace("\\\n", " ").replace("benchmarks.reports ", "benchmarks.reports.")
    commands = re.findall(block, text, re.MULTILINE)
    inline = re.findall(r"`python\s+-m\s+([\w.]+)", EVERYTHING)
    assert {*inline, *(command.split()[0] for command in commands)} >= ENDED
    assert not any(find_spec(name) for name in ENDED)
    for command in commands:
        name, *args = shlex.split(command)
        if name in ENDED:
            continue
        assert tyro.cli(import_module(name).Options, args=args)
    assert all(find_spec(name) for name in inline if name not in ENDED)


def best_rows(clip):
    """Return the rows of a clip at the best rates."""
    return [row for row in clip["rows"] if row["best"]]


def means(rows, *names):
    return [float(np.mean([row[name] for row in rows])) for name in names]


def test_pages__quote_the_committed_results():
    recordings = committed("demo")["full"], committed("arm")
    demo, arm = ([frame["psnr"] for frame in result["frames"]] for result in recordings)
    four, (thin,) = (committed(name)["clips"] for name in ("method_report", "method_parts"))
    rows = [row for clip in four for row in best_rows(clip) if row["epochs"] == 2]

    def best(preset, name):
        return np.array([row["mean"][name] for row in rows if row["preset"] == preset])

    names = "psnr", "psnr_moving"
    gains = [span(best("default", name) - best("baseline", name)) for name in names]
    errors = span(best("default", MOTION) / best("baseline", MOTION))
    parts = {row["preset"]: row["mean"]["psnr"] for row in best_rows(thin) if row["epochs"] == 2}
    fits = [fit for fit in committed("field")["fits"] if fit["epochs"] == 8]
    ours, grid = (
        means([fit for fit in fits if fit["method"] == method], "psnr_moving")
        for method in ("default", "grid")
    )
    drift = [fit for fit in committed("drift")["fits"] if fit["clip"] == "random-15"]
    drift_psnr, slope = means(drift, "psnr", "slope_moving_db_a_frame")
    unseen = [fit for fit in committed("random_scenes")["fits"] if fit["seed"] != 4]
    unseen_psnr, unseen_moving = means(unseen, "psnr", "psnr_moving")
    clocks = (f"{name}_moving" for name in ("synchronised", "recorded", "aligned"))
    one_clock, recorded, aligned = means(committed("timing")["fits"], *clocks)
    small, large, twice = (committed(f"render_speed_{name}") for name in ("W1", "W2b", "W2"))
    streams = {name: row["streams"] for name, row in committed("fuzz")["fuzzers"].items()}
    times = {row["name"]: row["seconds"] for row in committed("renderer_report")["rows"]}
    blocks = ("block 4x4", "block 8x8")
    small_blocks, large_blocks = (times[name] / times["1/255, 0.0001"] for name in blocks)
    walk = committed("walk4")
    held_out = {fit["recording"]: fit["frames"] for fit in committed("held_out")["fits"]}
    basketball, flame_steak = (
        np.mean([frame["psnr"] for frame in held_out[name]])
        for name in ("basketball", "flame_steak")
    )
    later = committed("frame_speed")["n3dv"]["runs"]["default, 2 epochs"]["seconds"]
    rooms = grouped(committed("starts_rooms")["fits"], "scene", "start")
    views, people = (
        [
            means(rooms[room, "found"], score)[0] - means(rooms[room, "random"], score)[0]
            for room in ("room 1", "room 2", "room 3")
        ]
        for score in ("psnr", "psnr_person")
    )
    quotes = f"""
method: PSNR goes from {demo[0]:.2f} dB to {demo[-1]:.2f} dB.
method: from {arm[0]:.2f} dB to {arm[-1]:.2f} dB over {len(arm)} frames
method: the means are {unseen_psnr:.2f} dB and {unseen_moving:.2f} dB where things move
method: {gains[0]} dB above residuals alone at their best rates ({gains[1]} dB where things move)
method: with {errors} of their motion error
method: PSNR falls by {-min(best("default", "psnr_slope")):.3f} dB a frame at most
method: Random scene 15 has {drift_psnr:.2f} dB, with a slope of {slope:+.2f} dB a frame
captures: PSNR is {one_clock:.1f}, {recorded:.1f} and {aligned:.1f} dB in the mean.
index: {basketball:.1f} dB | HiCoM
index: {later:.1f} s a later frame
index: {flame_steak:.1f} dB in one first frame
index: {small["step_ms"]:.0f} to {large["step_ms"]:.0f} ms a step
index: {small["ratio_to_yardstick"]:.1f} to {twice["ratio_to_yardstick"]:.1f} times the time of hand
renderer: {small["ratio_to_yardstick"]:.2f} to {twice["ratio_to_yardstick"]:.2f} times the time
renderer: {small["plain_step_ms"]:.0f} ms in the first row and {large["plain_step_ms"]:.0f} ms in
renderer: a step of the second row takes {100 * large["tenth_share"]:.0f} % of the time
codec: in {streams["damage"]:,} damaged streams and {streams["bytes"]:,} with changed bytes
index: {ours[0]:.1f} dB where things move | the next method {grid[0]:.1f} dB
index: {gains[1]} dB more where things move
method: Motion gains {parts["ml"] - parts["baseline"]:.2f} dB at 2 epochs
method: additions to the paper gain {parts["ml-mo-mc"] - parts["paper"]:.2f} dB
renderer: Blocks of 4x4 and 8x8 pixels take {small_blocks:.2f} and {large_blocks:.2f} of the time
first-frame: the held-out view gains {views[0]:.1f}, {views[1]:.1f} and {views[2]:.1f} dB
first-frame: The person gains {people[0]:.1f} dB in `room 1`
first-frame: and loses {-people[1]:.1f} and {-people[2]:.1f} dB in the other two
captures: {walk["psnr"]["first"]:.2f} dB in the first frame and {walk["psnr"]["last"]:.2f} dB in the
captures: {walk["psnr_moving"]:.2f} dB where things move
captures: A later frame takes {walk["seconds"]["per_later_frame"]:.1f} s
captures: and {walk["bytes"]["per_residual"] / 1000:.0f} kB
"""
    words = {name: " ".join(text.split()) for name, text in TEXTS.items()}
    pairs = [line.split(": ", 1) for line in quotes.strip().splitlines()]
    assert [quote for name, quote in pairs if quote not in words[name]] == []
