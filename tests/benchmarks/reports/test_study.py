"""Studies: a tiny run of every one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.reports import (
    cameras,
    drift,
    fits,
    random_scenes,
    real,
    timing,
)
from benchmarks.reports.study import Scene, rounded
from morgs_mi import StreamLoop
from morgs_mi.studio.synth.disturbances import load_disturbances
from tests.quick import quick

TINY = quick(dropping=0.0)
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "report",
    [pytest.param(report, marks=[pytest.mark.slow] * (report not in FAST)) for report in STUDIES],
    ids=lambda report: report.__name__.rpartition(".")[2],
)
def test_study_options__write_the_rows(report, clip: Path, tmp_path: Path, monkeypatch):
    for name in ("random-1", "random-2", "random-1-lens-0.1", "spheres-3x64"):
        (tmp_path / name).symlink_to(clip)
    study_options, num_rows = STUDIES[report]
    place = {"captures": (clip,)} if report is real else {"clips": tmp_path}
    monkeypatch.setattr(fits, "StreamLoop", tiny_loop)
    # Needs larger images.
    monkeypatch.setattr(cameras, "refine_cameras", lambda capture, *_: (capture, Scene({}, ())))
    monkeypatch.setattr(timing, "estimate_time_offsets", true_offsets)
    options = report.Options(json=tmp_path / "out.json", **place, **study_options)
    options.run()
    result = json.loads((tmp_path / "out.json").read_text())
    rows = result["fits"]
    assert len(rows) == num_rows
    assert {"settings", "commit", "date", "machine", "versions"} <= result.keys()
    assert "clips" not in result["settings"]
    assert "|" in options.table(rows)
    if report is timing:
        assert max(row["mean_error"] for row in rows) == 0
        assert [row["fit_seed"] for row in rows] == [0, 1]


def test_rounded__has_five_digits_of_what_is_no_integer():
    assert rounded({"a": [1 / 3, 7, None], "b": "x", "c": float("inf")}) == {
        "a": [0.33333, 7, None],
        "b": "x",
        "c": float("inf"),
    }
