"""Studies: their rows, resumption, and a tiny run of every one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.reports import (
    cameras,
    cells,
    drift,
    fits,
    random_scenes,
    real,
    study,
    timing,
)
from benchmarks.reports.cells import run_cells
from benchmarks.reports.study import Scene, Study, Variant, method_version, rounded
from morgs_mi import StreamLoop
from morgs_mi.capture.capture import load_capture
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.runs.cluster.workers import open_client
from morgs_mi.studio.synth.disturbances import load_disturbances
from tests.benchmarks.reports.here import client_here
from tests.quick import quick

TINY = quick(dropping=0.0)
# Figures that are times, which no two fits share.
TIMES = {"cpu_s", "seconds"}
FIRST = {"seeds": (1,), "downscale": 1, "steps": 3, "gaussians": 60}
SMALL = {"frames": 3, "width": 64, "gaussians": 60, "steps": 3, "epochs": 1, "fit_seeds": (0, 1)}
# Options of a tiny run, and the number of its rows.
STUDIES = {
    random_scenes: ({"seeds": (1,), "frames": 2}, 1),
    cameras: ({**FIRST, "degrees": (0.0, 0.5), "disturbances": (0,), "lens": 0.1}, 3),
    real: ({"width": 64, "gaussians": 60, "steps": 3}, 1),
    drift: ({**SMALL, "scenes": ("spheres",)}, 2),
    timing: ({**SMALL, "seeds": (3,), "frames": 6, "fitted": 2, "time_offset": 0.4}, 2),
}
FAST = (random_scenes,)


def tiny_loop(cameras, points, colors, config, image_masks):
    """Return a loop that fits a few Gaussians in a few steps."""
    fit = replace(TINY.fit, dropping=config.fit.dropping)
    return StreamLoop(
        cameras, points, colors, replace(config, fit=fit, render=TINY.render), image_masks
    )


def true_offsets(capture):
    """Return the true time offsets in place of those that a minute of work would find."""
    offsets = {
        name: -truth.time_offset
        for name, truth in load_disturbances(capture.path / "truth").items()
    }
    return SimpleNamespace(offsets=offsets, errors=dict.fromkeys(offsets, 0.1), reference="cam00")


def without_times(value):
    """Return figures without those that are times."""
    if isinstance(value, list):
        return [without_times(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    return {name: without_times(entry) for name, entry in value.items() if name not in TIMES}


@pytest.mark.slow
@pytest.mark.parametrize(
    "report",
    [pytest.param(report, marks=[pytest.mark.slow] * (report not in FAST)) for report in STUDIES],
    ids=lambda report: report.__name__.rpartition(".")[2],
)
def test_study_options__of_workers_write_the_rows_of_one_process(
    report, clip: Path, tmp_path: Path, monkeypatch
):
    for name in ("random-1", "random-2", "random-1-lens-0.1", "spheres-3x64"):
        (tmp_path / name).symlink_to(clip)
    study_options, num_rows = STUDIES[report]
    place = {"captures": (clip,)} if report is real else {"clips": tmp_path}
    tables = {}
    monkeypatch.setattr(fits, "StreamLoop", tiny_loop)
    # Needs larger images.
    monkeypatch.setattr(cameras, "refine_cameras", lambda capture, *_: (capture, Scene({}, ())))
    monkeypatch.setattr(timing, "estimate_time_offsets", true_offsets)
    monkeypatch.setattr(cells, "open_client", lambda scheduler, count: client_here())
    for count in (None, 2):
        options = report.Options(
            json=tmp_path / "out.json", workers=count, **place, **study_options
        )
        options.run()
        result = json.loads((tmp_path / "out.json").read_text())
        tables[count] = result["fits"]
    assert len(tables[None]) == num_rows
    assert {"settings", "commit", "date", "machine", "versions"} <= result.keys()
    assert "clips" not in result["settings"]
    assert "|" in options.table(tables[None])
    if report is timing:
        assert max(row["mean_error"] for row in tables[None]) == 0
        assert [row["fit_seed"] for row in tables[None]] == [0, 1]
    assert all(without_times(rows) == without_times(tables[None]) for rows in tables.values())


def score(source: Source, config: StreamConfig) -> dict[str, float]:
    """Return a score in place of a fit's."""
    CALLS.append(config.seed)
    return {"psnr": 30 + config.fit.epochs + config.seed / 3}


CALLS: list[int] = []


@pytest.mark.slow
def test_study__continues_with_the_stored_cells(clip: Path, tmp_path: Path, monkeypatch):
    source = Source.of(load_capture(clip))
    variants = [Variant({"epochs": n}, StreamConfig(FitConfig(epochs=n))) for n in (1, 2)]
    small_study = Study(score, [Scene({"clip": "a"}, (source,))], variants, (0, 1))
    CALLS.clear()
    rows = small_study.run(None, tmp_path)
    assert rows[1] == {"clip": "a", "epochs": 1, "fit_seed": 1, "psnr": 31.333}
    assert small_study.run(None, tmp_path) == rows
    assert CALLS == [0, 1, 0, 1], "the second run fits nothing"
    assert len(replace(small_study, seeds=(0, 1, 2)).run(None, tmp_path)) == 6
    assert CALLS[4:] == [2, 2], "only another seed is fitted"
    shorter = Scene({"clip": "a"}, (replace(source, num_frames=2),))
    replace(small_study, scenes=[shorter], seeds=(0,)).run(None, tmp_path)
    assert CALLS[6:] == [0, 0], "another part of the recording is fitted"
    monkeypatch.setattr(study, "method_version", lambda: "another")
    small_study.run(None, tmp_path)
    assert CALLS[8:] == [0, 1, 0, 1], "another version of the method fits again"
    assert len(small_study.run(None)) == 4
    assert len(CALLS) == 16, "nothing is stored without a folder"


def test_method_version__ignores_comments_and_depends_on_the_code(tmp_path: Path):
    versions = []
    for k, text in enumerate(("a = 1\n", "# Why.\na  =  1\n", "a = 2\n")):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "module.py").write_text(text)
        versions.append(method_version((folder,)))
    assert versions[0] == versions[1] != versions[2]


def test_rounded__has_five_digits_of_what_is_no_integer():
    assert rounded({"a": [1 / 3, 7, None], "b": "x", "c": float("inf")}) == {
        "a": [0.33333, 7, None],
        "b": "x",
        "c": float("inf"),
    }


@pytest.mark.slow
def test_run_cells__of_processes_gives_the_scores_of_one_process(clip: Path):
    capture = load_capture(clip)
    args = {seed: (Source.of(capture), 2, replace(TINY, seed=seed)) for seed in (0, 1)}
    pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    with open_client(count=2) as client:
        ours, theirs = (
            run_cells(random_scenes.measure, args, each, lambda *_: None) for each in (client, None)
        )
    assert without_times(list(ours.values())) == without_times(list(theirs.values()))
