"""Report on the method: stored cells are reused, and every figure is that of the cells."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import morgs_mi
from benchmarks.reports import __main__ as cli
from benchmarks.reports import method, method_cells
from benchmarks.reports.method import MethodReportConfig, aggregate, cells_of, report_method
from benchmarks.reports.method_cells import Cell, Clip, fit_cells, method_version, scores_of
from benchmarks.reports.method_results import FlowError, MethodClip, MethodResult, ScratchRow, SettingRow
from benchmarks.reports.method_tables import (
    ablation_table,
    best_rows,
    comparison_table,
    epochs_table,
    gains_table,
    key_views_rows,
    key_views_table,
    method_page,
)
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.executor import open_workers
from morgs_mi.config import StreamConfig
from morgs_mi.core.files import json_finite
from morgs_mi.fit.config import FitConfig
from morgs_mi.render.config import RenderConfig
from tests.benchmarks.reports.here import Here
from tests.benchmarks.reports.pages import ROOT, page

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


def made_up_scores(clip, config, first):
    """Scores in place of those of a fit; more epochs and key views are better."""
    score = 20.0 + config.fit.epochs + 0.1 * config.motion.key_views + 100 * config.fit.rates.means
    names = ("psnr", "psnr_moving", "psnr_still", "ssim", "motion_error_moving", "motion_error_still")
    names += ("true_motion_moving", "num_bytes", *(f"motion_3d_{name}" for name in method_cells._MOTION_3D))
    frames = {name: [score - 1, score + 1] for name in method_cells._BY_FRAME}
    rest = {"confidence_iou": None, "mtv": 0.5, "mtv_input": 0.6, "psnr_slope": 2.0, "seconds": 0.1 * score}
    return dict.fromkeys(names, score) | rest | {"by_frame": frames}


@pytest.fixture(scope="module", params=["made up", pytest.param("fitted", marks=pytest.mark.slow)])
def interrupted(request, clip, tmp_path_factory):
    """A report that was interrupted in its third cell and run again: result, folder, files of the first run, fits."""
    made_up = request.param == "made up"
    out, fits, fit = tmp_path_factory.mktemp("report"), [], made_up_scores if made_up else method_cells._fit

    def counted(clip, config, first):
        fits.append(config)
        if len(fits) == 3:
            raise KeyboardInterrupt
        return fit(clip, config, first)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(method_cells, "_fit", counted)
        if made_up:
            patch.setattr(method, "_SCRATCH", 1)
        with pytest.raises(KeyboardInterrupt):
            report_method([clip], out, TINY)
        stored = {path: path.stat().st_mtime_ns for path in (out / "spheres").iterdir()}
        result = report_method([clip], out, TINY)
    return result, out, stored, fits


def test_report_method__continues_an_interrupted_report(interrupted):
    result, out, stored, fits = interrupted
    assert sorted(path.suffix for path in stored) == [".json", ".json", ".morgs"]
    assert {path: path.stat().st_mtime_ns for path in stored} == stored
    # 2 epochs of a default and a baseline at 2 rates; 2 presets with 1, 2 and all 3 views at 2 epochs.
    assert len(fits) == 6 + 6 + 1
    assert len(list(out.rglob("first-*.morgs"))) == 1
    assert len(list(out.rglob("scratch-*.json"))) == 1
    (found,) = result.clips
    assert [(row.preset, row.epochs, row.rates) for row in best_rows(found)[2:]] == [
        ("default", 1, 1.0),
        ("default", 2, 1.0),
    ]
    order = [(row.preset, row.key_views) for row in key_views_rows(found)]
    assert order == [(preset, views) for preset in ("ml", "ml-mo") for views in (1, 2, 4)]


def test_method_command__repeats_a_finished_report_without_a_fit(clip, interrupted, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    result, out, *_ = interrupted
    monkeypatch.setattr(method_cells, "_fit", None)
    monkeypatch.setattr(Clip, "loop", None)
    monkeypatch.setattr(method, "_SCRATCH", result.clips[0].scratch[0].steps // (8 * 3))
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
    for table in (ablation_table(result.clips[0], 2), epochs_table(result.clips[0])):
        assert table in page
    value = json.loads((tmp_path / "out" / "method.json").read_text())
    assert value["clips"][0]["scratch"][0]["frame"] == 2
    assert json_finite(MethodResult.from_dict(value).as_dict()) == value
    assert (tmp_path / "out" / "method.png").stat().st_size > 10_000


def test_report_method__scores_are_those_of_the_held_out_view(interrupted):
    (found,) = interrupted[0].clips
    for row in found.rows + found.key_view_rows:
        mean = row.mean
        assert mean["psnr"] == pytest.approx(sum(row.by_frame["psnr"]) / 2)
        assert 5 < mean["psnr"] < 40
        assert mean["seconds"] > 0
        assert 0 < mean["motion_error_moving"] < 5 * mean["true_motion_moving"]
        assert mean["mtv_input"] == found.rows[0].mean["mtv_input"]
        assert all(spread != spread for spread in row.std.values())  # NaN for a single run
    assert 0 < found.flow.error < 2
    (scratch,) = found.scratch
    assert 5 < scratch.psnr < 40


def test_method_tables__are_complete(interrupted):
    (found,) = interrupted[0].clips
    for table, rows in ((ablation_table(found, 2), 2), (epochs_table(found), 4), (key_views_table(found), 6)):
        lines = table.splitlines()
        assert len(lines) == 2 + rows
        assert len({line.count("|") for line in lines}) == 1
        assert "nan" not in table


def test_gains_and_comparison__are_those_of_the_best_rates():
    def row(preset: str, epochs: int, rates: float, best: bool, psnr: float, error: float) -> SettingRow:
        mean = {"psnr": psnr, "psnr_moving": psnr - 10, "motion_error_moving": error, "mtv": float("nan")}
        return SettingRow(preset, epochs, 4, rates, 1, mean, {}, {}, best)

    rows = [row("baseline", 8, 1, False, 30.0, 2.0), row("baseline", 8, 4, True, 31.0, 3.0)]
    rows += [row("ml", 8, 1, True, 32.5, 1.5), row("default", 8, 2, True, 33.0, 0.9), row("default", 2, 1, True, 31, 1)]
    clip = MethodClip("balls", 4, 3, 48, 36, True, FlowError(0.5, 0.4), (), tuple(rows), ())
    gains = [line.split(" | ") for line in gains_table([clip]).splitlines()]
    assert gains[3][:4] == ["| balls", "8", "+1.50 / +1.50 / -1.50", "- / - / -"]
    found = dict(line.strip("| ").split(" | ") for line in comparison_table([clip]).splitlines()[2:])
    assert found["PSNR at 8 epochs over `baseline`, dB"] == "2.00"
    assert found["PSNR at 2 epochs over `baseline`, dB"] == "-"
    assert found["motion error as a share of the flow's own"] == "1.80"
    assert found["motion error as a share of `baseline`'s"] == "0.30"
    assert found["mTV as a share of the recording's"] == "-"
    others = tuple(replace(row, preset=row.preset.replace("default", "ml-mo-mc")) for row in rows)
    assert comparison_table([replace(clip, rows=others)]) == comparison_table([clip])
    for flow in (None, FlowError(0.0, 0.0)):  # unknown, perfect
        assert "flow's own | - |" in comparison_table([replace(clip, flow=flow)])


def test_scores_of__is_that_of_the_held_out_view_of_a_fit(clip, tmp_path):
    """One genuine fit; the fixture `interrupted` makes up its scores unless slow tests run."""
    recording, cell = Clip.read(load_capture(clip)), Cell("default", 1, 1, 1.0, 0)
    scores = scores_of(recording, cell, TINY.base, "test", tmp_path)
    assert scores["psnr"] == pytest.approx(sum(scores["by_frame"]["psnr"]) / 2)
    assert 5 < scores["psnr"] < 40
    assert scores["seconds"] > 0
    assert 0 < scores["motion_error_moving"] < 5 * scores["true_motion_moving"]
    assert scores.keys() == made_up_scores(recording, cell.config(TINY.base), None).keys()


def test_scores_of__fits_another_version_or_setting_again(clip, tmp_path, monkeypatch):
    fits = []
    monkeypatch.setattr(method_cells, "_first_frame", lambda *_: None)
    monkeypatch.setattr(method_cells, "_fit", lambda *_: fits.append(None) or {"psnr": float(len(fits))})
    whole, base, cell = Clip.read(load_capture(clip)), StreamConfig(), Cell("ml", 2, 4, 1.0, 0)
    shorter = Clip.read(load_capture(clip, max_frames=2))
    calls = [
        (whole, cell, base, "a"),
        (whole, cell, base, "b"),
        (whole, replace(cell, rates=2.0), base, "a"),
        (whole, cell, replace(base, fit=FitConfig(first_frame_steps=9)), "a"),
        (shorter, cell, base, "a"),
    ]
    for _ in range(2):
        assert [scores_of(*each, tmp_path)["psnr"] for each in calls] == [1, 2, 3, 4, 5]
    (stored,) = tmp_path.glob("spheres/ml-2e-4k-2x-s0-*.json")
    stored.write_text("{")
    with pytest.raises(ValueError, match="expected a cell's scores"):
        scores_of(*calls[2], tmp_path)


def test_report_method__of_workers_is_that_of_one_process(clip, tmp_path, monkeypatch):
    """Also if a worker dies, and the report is started again."""
    monkeypatch.setattr(method_cells, "_fit", made_up_scores)
    monkeypatch.setattr(method, "_SCRATCH", 1)
    alone = report_method([clip], tmp_path / "alone", replace(TINY, seeds=2))
    with pytest.raises(ChildProcessError):
        report_method([clip], tmp_path / "workers", replace(TINY, seeds=2), workers=Here(dies_at=4))
    before = set((tmp_path / "workers").rglob("*-s0-*.json"))
    assert len(before) > 2
    workers = Here()
    found = report_method([clip], tmp_path / "workers", replace(TINY, seeds=2), workers=workers)
    files = [{path.name for path in (tmp_path / name).rglob("*.*")} for name in ("alone", "workers")]
    assert files[0] == files[1]
    assert 99 - workers.left == len(list((tmp_path / "workers").rglob("*e-*k-*.json"))) - len(before)
    ours, theirs = (json_finite(result.as_dict())["clips"][0] for result in (found, alone))
    assert all(ours[name] == theirs[name] for name in ("rows", "key_view_rows"))


@pytest.mark.slow
def test_fit_cells__gives_the_scores_of_one_process(clip, tmp_path):
    base = replace(TINY.base, render=RenderConfig(reproducible=True))
    recording, cells = Clip.read(load_capture(clip)), [Cell("default", epochs, 1, 1.0, 0) for epochs in (1, 2)]
    with open_workers(count=2) as workers:
        fit_cells(recording, cells, base, "test", tmp_path / "workers", workers, lambda _: None)
    for cell in cells:
        ours, theirs = (scores_of(recording, cell, base, "test", tmp_path / name) for name in ("workers", "alone"))
        for scores in (ours, theirs):
            scores.pop("seconds")
        assert json_finite(ours) == json_finite(theirs)


def write_package(folder: Path, **changed: str) -> Path:
    """Write a package of a few modules, of which `changed` have another text."""
    texts = {
        "stream_loop": "from morgs_mi.method import lift\nfrom morgs_mi.render.loops import blend\n",
        "method/lift": "from morgs_mi.method.weights import weight\n",
        "method/weights": "weight = 1\n",
        "method/__init__": "",
        "render/loops": "blend = 1\n",
        "viewer/__init__": "import morgs_mi\n",
        **{f"evaluate/{Path(name).stem}": "" for name in (*method_cells._EVALUATION, "environment.py")},
    } | changed
    for name, text in texts.items():
        path = folder / "morgs_mi" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "morgs_mi"


def test_method_version__ignores_comments_and_depends_on_the_code(tmp_path):
    first = method_version(write_package(tmp_path / "first"))
    assert first == method_version(write_package(tmp_path / "same"))
    for k, (file, text, other) in enumerate(
        (
            ("render/loops", "# Why.\nblend  =  1\n", False),
            ("viewer/__init__", "number = 1\n", False),
            ("evaluate/environment", "number = 1\n", False),
            ("method/lift", "number = 1\n", True),
            ("method/weights", "weight = 2\n", True),
            ("evaluate/evaluate", "number = 1\n", True),
            ("render/loops", "blend = 2\n", True),
        )
    ):
        assert (method_version(write_package(tmp_path / str(k), **{file: text})) != first) == other, (file, text)


def test_method_version__depends_on_the_loop_and_the_evaluation():
    package = Path(morgs_mi.__file__).parent
    files = {path.relative_to(package).as_posix() for path in method_cells._sources(package)}
    assert {"stream_loop.py", "method/lift.py", "render/loops.py", "evaluate/evaluate.py"} <= files
    assert not files & {"viewer/__init__.py", "evaluate/environment.py"}


def test_cell__config_changes_its_own_settings_only():
    base = MethodReportConfig().base
    config = Cell("paper", 3, 2, 4.0, 7).config(base)
    assert (config.fit.epochs, config.motion.key_views, config.seed) == (3, 2, 7)
    assert config.fit.rates.means == 4 * base.fit.rates.means
    assert config.fit.first_frame_rates == base.fit.first_frame_rates
    assert not config.motion.lift_flow
    assert Cell("default", base.fit.epochs, base.motion.key_views, 1.0, base.seed).config(base) == base


def test_aggregate__selects_the_best_rate_by_the_first_seed():
    found = {}
    for rate, values in ((1.0, (30.0, 40.0)), (2.0, (31.0, 33.0)), (4.0, (20.0,))):
        for seed, psnr in enumerate(values):
            found[Cell("baseline", 2, 4, rate, seed)] = {"psnr": psnr, "ssim": None, "by_frame": {"psnr": [psnr, 1.0]}}
    rows = aggregate(found)
    assert [row.best for row in rows] == [False, True, False]
    assert rows[1].mean["psnr"] == 32
    assert rows[1].std["psnr"] == pytest.approx(2**0.5)
    assert rows[1].by_frame["psnr"] == (32, 1)
    assert rows[1].mean["ssim"] != rows[1].mean["ssim"]


def test_method_page__warns_of_a_best_rate_that_is_the_largest_one(interrupted):
    def warns(best: float) -> bool:
        rows = tuple(replace(row, best=row.rates == best or row.preset == "default") for row in found.rows)
        page = method_page(replace(result, clips=(replace(found, rows=rows),)))
        return "Larger rates than were tried may be better for `baseline` at 1 epochs, `baseline` at 2 epochs." in page

    result = interrupted[0]
    (found,) = result.clips
    assert warns(2.0)
    assert not warns(1.0)


def test_cells_of__tunes_the_given_presets_and_limits_the_key_views():
    presets, key_views = cells_of(TINY, num_views=3)
    assert len(presets) == 2 * 3
    assert {cell.rates for cell in presets if cell.preset == "default"} == {1.0}
    assert {cell.key_views for cell in presets} == {3}
    assert {(cell.preset, cell.key_views) for cell in key_views} == {(p, v) for p in ("ml", "ml-mo") for v in (1, 2, 3)}
    assert {cell.epochs for cell in key_views} == {2}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"presets": ("ml", "none")}, "`presets` and `tuned` must be among default, .*, got none"),
        ({"epochs": ()}, "`epochs` must be positive"),
        ({"rates": (1, 0)}, "`rates` must be positive"),
        ({"seeds": 0}, "`seeds` must be positive, got 0"),
        ({"key_views": (0,)}, "`key_views` at least 1"),
    ],
)
def test_method_report_config__refuses_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        MethodReportConfig(**settings)


def test_report_method__runs_later_seeds_at_the_best_rate_only(clip, tmp_path, monkeypatch):
    ran = []

    def scores(clip, cell, base, version, out):
        ran.append(cell)
        psnr = 30.0 + {1: 1, 2: 3, 4: 2}[cell.rates] * (1 if cell.epochs == 2 else -1)
        return {"psnr": psnr + 10 * cell.seed, "by_frame": {}}

    def from_scratch(clip, frame, base, steps, version, out):
        assert (frame, steps) == (2, 20 * 8 * 4)
        return ScratchRow(frame, steps, 30.0, 25.0, 31.0, 0.9, 1.0)

    monkeypatch.setattr("benchmarks.reports.method.scores_of", scores)
    monkeypatch.setattr("benchmarks.reports.method.scratch_scores", from_scratch)
    config = replace(TINY, rates=(1, 2, 4), tuned=("baseline",), seeds=3, key_views=())
    (found,) = report_method([clip], tmp_path, config).clips
    assert [cell.seed for cell in ran] == 8 * [0] + 4 * [1] + 4 * [2]
    assert {(c.preset, c.epochs, c.rates) for c in ran if c.seed == 1} == {
        ("baseline", 1, 1),
        ("baseline", 2, 2),
        ("default", 1, 1),
        ("default", 2, 1),
    }
    best = {(row.preset, row.epochs): row for row in best_rows(found)}
    for epochs, rates, psnr in ((1, 1, 39), (2, 2, 43)):
        row = best["baseline", epochs]
        assert (row.rates, row.runs, row.mean["psnr"]) == (rates, 3, psnr)


def test_report_method__refuses_bad_captures(clip, tmp_path):
    with pytest.raises(ValueError, match="with distinct names, got spheres, spheres"):
        report_method([clip, clip], tmp_path, TINY)
    with pytest.raises(ValueError, match="two frames or more, got 1"):
        report_method([clip], tmp_path, replace(TINY, frames=1))


def test_method_page__has_no_other_figures_than_the_report():
    for name, section in (("method_report", "Four clips"), ("method_parts", "Parts")):
        result = json.loads((ROOT / f"benchmarks/results/{name}.json").read_text(encoding="utf-8"))
        (found,) = re.findall(rf"^## {section}\n(.*?)^##", page("method.md"), re.DOTALL | re.MULTILINE)
        tables = method_page(MethodResult.from_dict(result))
        assert set(re.findall(r"\d+\.\d+", found)) - set(re.findall(r"\d+\.\d+", tables)) == set()
        # Null means all frames.
        assert f"{result['settings']['frames'] or result['clips'][0]['frames']} frames" in found
