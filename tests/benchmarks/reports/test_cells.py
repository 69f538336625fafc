"""Reports whose cells are fitted by workers."""

from __future__ import annotations

import json
import logging
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.reports import (
    cells,
    drift,
    estimates,
    fast_parts,
    few_views,
    first_frame,
    fits,
    generalise,
    live,
    masks,
    random_scenes,
)
from benchmarks.reports.cells import run_cells
from benchmarks.reports.generalise import measure
from morgs_mi import StreamLoop
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.executor import open_workers
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.fit.config import FitConfig
from morgs_mi.render.config import RenderConfig
from tests.benchmarks.reports.here import Here

TINY = StreamConfig(
    fit=FitConfig(num_gaussians=60, first_frame_steps=3, epochs=1, dropping=0.0),
    render=RenderConfig(reproducible=True),
)
SMALL = {"seeds": (1,), "downscale": 1, "steps": 3, "gaussians": 60}
# Figures that are times, which no two fits share.
TIMES = {"seconds", "cpu_s", "processor_ms"}
REPORTS = {
    random_scenes: {"seeds": (1,), "frames": 2},
    fast_parts: {"seeds": (1,), "frames": 2, "strides": (1,)},
    generalise: {"seeds": (1, 2), "steps": 3},
    few_views: {**SMALL, "rigs": ("random",), "views": (2,), "points": ("random",)},
    first_frame: {"seeds": (1,), "steps": 3, "gaussians": 60},
    estimates: {**SMALL, "views": (3,)},
    drift: {"scenes": ("random-1",), "frames": 3, "fit_seeds": (0,)},
    live: {"scenes": ("random-1",), "frames": 3, "strides": (1,), "gap": 1, "gap_epochs": (2,), "steps": 3},
    masks: {"frames": 1, "loops": ("none",)},
}
# Reports with several fits per clip.
SLOW = (fast_parts, generalise, live, masks)


def tiny_loop(cameras, points, colors, config, image_masks):
    """Return a loop that fits a few Gaussians in a few steps."""
    fit = replace(TINY.fit, cross_validation=config.fit.cross_validation, dropping=config.fit.dropping)
    return StreamLoop(cameras, points, colors, replace(config, fit=fit, render=TINY.render), image_masks)


def without_times(value):
    """Return figures without those that are times."""
    if isinstance(value, list):
        return [without_times(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    return {name: without_times(entry) for name, entry in value.items() if name not in TIMES}


@pytest.mark.parametrize(
    "report",
    [pytest.param(report, marks=[pytest.mark.slow] * (report in SLOW)) for report in REPORTS],
    ids=lambda report: report.__name__.rpartition(".")[2],
)
def test_main__of_workers_writes_the_figures_of_one_process(report, clip: Path, tmp_path: Path, monkeypatch):
    for seed in (1, 2):
        (tmp_path / f"random-{seed}").symlink_to(clip)
    settings = {"captures": (clip,)} if report is masks else {"clips": tmp_path}
    workers, found = Here(), {}
    monkeypatch.setattr(fits, "StreamLoop", tiny_loop)
    monkeypatch.setattr(cells, "open_workers", contextmanager(lambda scheduler, count: iter([workers])))
    for count in (None, 2):
        report.main(report.Options(json=tmp_path / "out.json", workers=count, **settings, **REPORTS[report]))
        found[count] = without_times(json.loads((tmp_path / "out.json").read_text()))
    assert workers.left < 99, "a worker was at work"
    assert found[2] == found[None]


def square(number: int) -> int:
    if number < 0:
        raise ValueError(f"{number}: expected a positive number.")
    logging.getLogger("morgs_mi").warning("squared")
    return number * number


@pytest.mark.parametrize("workers", [None, Here()])
def test_run_cells__returns_the_results_in_order_with_their_warnings(workers, caplog: pytest.LogCaptureFixture):
    arrived = []
    found = run_cells(square, {"b": (2,), "a": (1,)}, workers, lambda *each: arrived.append(each))
    assert list(found.items()) == arrived == [("b", 4), ("a", 1)]
    assert "squared" in caplog.messages


@pytest.mark.parametrize("workers", [None, Here()])
def test_run_cells__raises_the_error_of_a_cell(workers):
    with pytest.raises(ValueError, match="-1: expected a positive number"):
        run_cells(square, {"a": (-1,)}, workers, lambda *_: None)


@pytest.mark.slow
def test_run_cells__of_processes_gives_the_scores_of_one_process(clip: Path):
    source = Source.of(load_capture(clip))
    args = {seed: (source, replace(TINY, seed=seed)) for seed in (0, 1)}
    with open_workers(count=2) as workers:
        ours, theirs = (run_cells(measure, args, each, lambda *_: None) for each in (workers, None))
    assert without_times(list(ours.values())) == without_times(list(theirs.values()))
