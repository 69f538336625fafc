"""The report on the method: what was fitted is not fitted again, and every figure is that of the cells."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import morgs_mi
from benchmarks.reports import __main__ as cli
from benchmarks.reports import method_cells
from benchmarks.reports.method import MethodReportConfig, aggregate, cells_of, report_method
from benchmarks.reports.method_cells import Cell, Clip, method_version, scores_of
from benchmarks.reports.method_tables import (
    ablation_table,
    aims_table,
    best_rows,
    epochs_table,
    gains_table,
    key_views_table,
    method_page,
)
from morgs_mi.capture.capture import load_capture
from morgs_mi.fit.config import FitConfig
from morgs_mi.stream_loop import StreamConfig
from morgs_mi.synth.synthesize import synthesize

ROOT = Path(__file__).parents[3]
TINY = MethodReportConfig(
    presets=("baseline", "default"),
    epochs=(1, 2),
    key_views=(1, 2, 99),
    rates=(1, 2),
    tuned=("baseline",),
    seeds=1,
    num_gaussians=200,
    scratch=1,
    version="test",
    stream=StreamConfig(fit=FitConfig(sh_degree=0, first_frame_steps=10, confidence_steps=2)),
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """The balls from 4 cameras in 3 tiny frames."""
    folder = tmp_path_factory.mktemp("clip") / "spheres"
    return synthesize("spheres", folder, num_cameras=4, num_frames=3, width=48, height=36, spp=1)


@pytest.fixture(scope="module")
def interrupted(clip, tmp_path_factory):
    """A report that was interrupted in its third cell and run again: result, folder, files of the first run, fits."""
    out, fits, fit = tmp_path_factory.mktemp("report"), [], method_cells._fit

    def counted(clip, config, first):
        fits.append(config)
        if len(fits) == 3:
            raise KeyboardInterrupt
        return fit(clip, config, first)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(method_cells, "_fit", counted)
        with pytest.raises(KeyboardInterrupt):
            report_method([clip], out, TINY)
        kept = {path: path.stat().st_mtime_ns for path in (out / "spheres").iterdir()}
        result = report_method([clip], out, TINY)
    return result, out, kept, fits


def test_an_interrupted_report_goes_on_where_it_was(interrupted):
    result, out, kept, fits = interrupted
    assert sorted(path.suffix for path in kept) == [".json", ".json", ".morgs"]
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    # 2 epochs of a default and a baseline at 2 rates; 2 presets with 1, 2 and all 3 views at 2 epochs.
    assert len(fits) == 6 + 6 + 1
    assert len(list(out.rglob("first-*.morgs"))) == 1
    assert len(list(out.rglob("scratch-*.json"))) == 1
    (found,) = result["clips"]
    assert [(row["preset"], row["epochs"], row["rates"]) for row in best_rows(found)[2:]] == [
        ("default", 1, 1.0),
        ("default", 2, 1.0),
    ]
    assert {row["key_views"] for row in found["key_view_rows"]} == {1, 2, 3}


def test_a_finished_report_is_made_again_without_a_fit(clip, interrupted, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    result, out, *_ = interrupted
    monkeypatch.setattr(method_cells, "_fit", None)
    shutil.copytree(out, tmp_path / "out")
    args = [
        "--presets",
        "baseline",
        "default",
        "--epochs",
        "1",
        "2",
        "--key-views",
        "1",
        "2",
        "99",
        "--rates",
        "1",
        "2",
    ]
    args += ["--tuned", "baseline", "--seeds", "1", "--num-gaussians", "200", "--scratch", "1", "--version", "test"]
    fit = ["--sh-degree", "0", "--first-frame-steps", "10", "--confidence-steps", "2"]
    args += [word.replace("--", "--stream.fit.") for word in fit]
    assert cli.main(["method", str(clip), "--out", str(tmp_path / "out"), *args]) == 0
    page = (tmp_path / "out" / "method.md").read_text()
    assert page.strip() in capsys.readouterr().out
    for table in (ablation_table(result["clips"][0], 2), epochs_table(result["clips"][0])):
        assert table in page
    assert json.loads((tmp_path / "out" / "method.json").read_text())["clips"][0]["scratch"][0]["frame"] == 2
    assert (tmp_path / "out" / "method.png").stat().st_size > 10_000


def test_scores_are_those_of_the_held_out_view(interrupted):
    (found,) = interrupted[0]["clips"]
    for row in found["rows"] + found["key_view_rows"]:
        mean = row["mean"]
        assert mean["psnr"] == pytest.approx(sum(row["by_frame"]["psnr"]) / 2)
        assert 5 < mean["psnr"] < 40
        assert mean["seconds"] > 0
        assert 0 < mean["motion_error_moving"] < 5 * mean["true_motion_moving"]
        assert mean["mtv_input"] == found["rows"][0]["mean"]["mtv_input"]
        assert all(spread != spread for spread in row["std"].values())  # one run tells none
    assert 0 < found["cue"]["error"] < 2
    (scratch,) = found["scratch"]
    assert scratch["steps"] == 20 * 8 * 3
    assert 5 < scratch["psnr"] < 40


def test_tables_are_whole(interrupted):
    (found,) = interrupted[0]["clips"]
    for table, rows in ((ablation_table(found, 2), 2), (epochs_table(found), 4), (key_views_table(found), 6)):
        lines = table.splitlines()
        assert len(lines) == 2 + rows
        assert len({line.count("|") for line in lines}) == 1
        assert "nan" not in table


def test_gains_and_aims_are_those_of_the_best_rates():
    def row(preset: str, epochs: int, rates: float, best: bool, psnr: float, error: float) -> dict:
        mean = {"psnr": psnr, "psnr_moving": psnr - 10, "motion_error_moving": error, "mtv": None}
        return {"preset": preset, "epochs": epochs, "rates": rates, "best": best, "mean": mean}

    rows = [row("baseline", 8, 1, False, 30.0, 2.0), row("baseline", 8, 4, True, 31.0, 3.0)]
    rows += [row("ml", 8, 1, True, 32.5, 1.5), row("default", 8, 2, True, 33.0, 0.9), row("default", 2, 1, True, 31, 1)]
    clip = {"name": "balls", "rows": rows, "cue": {"error": 0.5}}
    gains = [line.split(" | ") for line in gains_table([clip]).splitlines()]
    assert gains[3][:4] == ["| balls", "8", "+1.50 / +1.50 / -1.50", "- / - / -"]
    aims = {line.split(" | ")[0]: line.split(" | ")[1:] for line in aims_table([clip]).splitlines()}
    assert aims["| PSNR at 8 epochs over `baseline`, dB"] == ["at least 0.5", "**2.00** |"]
    assert aims["| PSNR at 2 epochs over `baseline`, dB"] == ["at least 1.5", "- |"]
    assert aims["| motion error as a share of the flow's own"] == ["at most 1.2", "1.80 |"]
    assert aims["| motion error as a share of `baseline`'s"] == ["at most 0.33", "**0.30** |"]
    assert aims["| mTV as a share of the recording's"] == ["0.9 to 1.1", "- |"]
    others = [{**row, "preset": row["preset"].replace("default", "ml-mo-mc")} for row in rows]
    assert aims_table([{**clip, "rows": others}]) == aims_table([clip])
    assert "flow's own | at most 1.2 | - |" in aims_table([{**clip, "cue": {"error": 0.0}}])  # of a perfect flow


def test_another_version_or_setting_is_fitted_again(clip, tmp_path, monkeypatch):
    fits = []
    monkeypatch.setattr(method_cells, "_first_frame", lambda *_: None)
    monkeypatch.setattr(method_cells, "_fit", lambda *_: fits.append(None) or {"psnr": float(len(fits))})
    whole, base, cell = Clip.read(load_capture(clip)), StreamConfig(), Cell("ml", 2, 4, 1.0, 0)
    shorter = Clip.read(load_capture(clip, max_frames=2))
    asked = [
        (whole, cell, base, "a"),
        (whole, cell, base, "b"),
        (whole, replace(cell, rates=2.0), base, "a"),
        (whole, cell, replace(base, fit=FitConfig(first_frame_steps=9)), "a"),
        (shorter, cell, base, "a"),
    ]
    for _ in range(2):
        assert [scores_of(*each, tmp_path)["psnr"] for each in asked] == [1, 2, 3, 4, 5]
    (kept,) = tmp_path.glob("spheres/ml-2e-4k-2x-s0-*.json")
    kept.write_text("{")
    with pytest.raises(ValueError, match="expected a cell's scores"):
        scores_of(*asked[2], tmp_path)


def test_a_comment_is_no_other_version_and_a_number_is(tmp_path):
    package = shutil.copytree(Path(morgs_mi.__file__).parent, tmp_path / "morgs_mi")
    first = method_version(package)
    assert first == method_version()
    for file, text, other in (
        ("method/lift.py", "# Why.", False),
        ("viewer/__init__.py", "number = 1", False),
        ("evaluate/environment.py", "number = 1", False),
        ("method/lift.py", "number = 1", True),
        ("evaluate/evaluate.py", "number = 1", True),
        ("render/loops.py", "number = 1", True),
    ):
        path = package / file
        path.parent.mkdir(exist_ok=True)
        before = path.read_text() if path.exists() else ""
        path.write_text(f"{before}\n{text}\n")
        assert (method_version(package) != first) == other, (file, text)
        path.write_text(before)


def test_a_cell_changes_what_it_says_and_no_more():
    base = MethodReportConfig().base
    config = Cell("paper", 3, 2, 4.0, 7).config(base)
    assert (config.fit.epochs, config.motion.key_views, config.seed) == (3, 2, 7)
    assert config.fit.rates.means == 4 * base.fit.rates.means
    assert config.fit.first_frame_rates == base.fit.first_frame_rates
    assert not config.motion.lift_flow
    assert Cell("default", base.fit.epochs, base.motion.key_views, 1.0, base.seed).config(base) == base


def test_the_first_seed_decides_which_rate_is_best():
    found = {}
    for rate, values in ((1.0, (30.0, 40.0)), (2.0, (31.0, 33.0)), (4.0, (20.0,))):
        for seed, psnr in enumerate(values):
            found[Cell("baseline", 2, 4, rate, seed)] = {"psnr": psnr, "ssim": None, "by_frame": {"psnr": [psnr, 1.0]}}
    rows = aggregate(found)
    assert [row["best"] for row in rows] == [False, True, False]
    assert rows[1]["mean"]["psnr"] == 32
    assert rows[1]["std"]["psnr"] == pytest.approx(2**0.5)
    assert rows[1]["by_frame"]["psnr"] == [32, 1]
    assert rows[1]["mean"]["ssim"] != rows[1]["mean"]["ssim"]


def test_a_best_rate_at_the_edge_of_what_was_tried_is_told(interrupted):
    def told(best: float) -> bool:
        rows = [{**row, "best": row["rates"] == best or row["preset"] == "default"} for row in found["rows"]]
        page = method_page({**result, "clips": [{**found, "rows": rows}]})
        return "Larger rates than were tried may be better for `baseline` at 1 epochs, `baseline` at 2 epochs." in page

    result = interrupted[0]
    (found,) = result["clips"]
    assert told(2.0)
    assert not told(1.0)


def test_every_preset_is_tuned_or_not_and_views_are_at_most_all():
    presets, key_views = cells_of(TINY, num_views=3)
    assert len(presets) == 2 * 3
    assert {cell.rates for cell in presets if cell.preset == "default"} == {1.0}
    assert {cell.key_views for cell in presets} == {3}
    assert {(cell.preset, cell.key_views) for cell in key_views} == {(p, v) for p in ("ml", "ml-mo") for v in (1, 2, 3)}
    assert {cell.epochs for cell in key_views} == {2}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"presets": ("ml", "none")}, "`presets` and `tuned` must be out of default, .*, got none"),
        ({"epochs": ()}, "`epochs` must be positive"),
        ({"rates": (1, 0)}, "`rates` must be positive"),
        ({"seeds": 0}, "`seeds` must be positive, got 0"),
        ({"key_views": (0,)}, "`key_views` at least 1"),
    ],
)
def test_bad_settings_get_a_sentence(settings, message):
    with pytest.raises(ValueError, match=message):
        MethodReportConfig(**settings)


def test_later_seeds_run_at_the_best_rate_alone(clip, tmp_path, monkeypatch):
    ran = []

    def scores(clip, cell, base, version, out):
        ran.append(cell)
        psnr = 30.0 + {1: 1, 2: 3, 4: 2}[cell.rates] * (1 if cell.epochs == 2 else -1)
        return {"psnr": psnr + 10 * cell.seed, "by_frame": {}}

    monkeypatch.setattr("benchmarks.reports.method.scores_of", scores)
    config = replace(TINY, rates=(1, 2, 4), tuned=("baseline",), seeds=3, key_views=(), scratch=0)
    (found,) = report_method([clip], tmp_path, config)["clips"]
    assert [cell.seed for cell in ran] == 8 * [0] + 4 * [1] + 4 * [2]
    assert {(c.preset, c.epochs, c.rates) for c in ran if c.seed == 1} == {
        ("baseline", 1, 1),
        ("baseline", 2, 2),
        ("default", 1, 1),
        ("default", 2, 1),
    }
    best = {(row["preset"], row["epochs"]): row for row in best_rows(found)}
    for epochs, rates, psnr in ((1, 1, 39), (2, 2, 43)):
        row = best["baseline", epochs]
        assert (row["rates"], row["runs"], row["mean"]["psnr"]) == (rates, 3, psnr)


def test_bad_captures_get_a_sentence(clip, tmp_path):
    with pytest.raises(ValueError, match="each of another name, got spheres, spheres"):
        report_method([clip, clip], tmp_path, TINY)
    with pytest.raises(ValueError, match="two frames or more, got 1"):
        report_method([clip], tmp_path, replace(TINY, frames=1))


def test_the_documentation_names_every_figure(interrupted):
    text = (ROOT / "docs/experiments/method.md").read_text(encoding="utf-8")
    result = interrupted[0]
    (found,) = result["clips"]
    row = found["rows"][0]
    for names in (result, found, row, row["mean"], row["by_frame"], found["scratch"][0], found["cue"]):
        assert [name for name in names if f"`{name}`" not in text] == []


@pytest.mark.parametrize(("name", "page"), [("method_report", "method.md"), ("method_parts", "method-parts.md")])
def test_the_documentation_quotes_the_committed_figures(name, page):
    result = json.loads((ROOT / f"benchmarks/results/{name}.json").read_text(encoding="utf-8"))
    text, tables = (ROOT / "docs/experiments" / page).read_text(encoding="utf-8"), method_page(result).strip()
    assert tables in text
    # What is said about them holds no figure of its own.
    (found,) = re.findall(r"^## What was found\n(.*?)^## ", text, re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"\d+\.\d+", found)) <= set(re.findall(r"\d+\.\d+", tables))
    settings = result["settings"]
    # An entry of null stands for all frames.
    assert f"{settings['frames'] or result['clips'][0]['frames']} frames" in found
    assert f"{settings['seeds']} seed" in found
