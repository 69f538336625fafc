"""Motion models of other publications, times, and pictures, at a tiny size."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import pictures
from benchmarks.field import anchors, hicom, motion_grid, transformation_cache  # noqa: F401, they register models
from benchmarks.speed import frame_speed, pairs
from morgs_mi.platform.bounded import read_json
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.recording import CONFIG, recording
from tests.scenes.shifted_ball import PLAIN, SHIFT, fit_shifted

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["hicom", "cache", "grid", "grid-slow", "anchors"])
def test_motion_models__move_gaussians_like_their_images(name):
    motion = np.asarray(fit_shifted(replace(PLAIN, model=name)).gaussians.motion)
    assert motion.mean(axis=0) @ SHIFT > 0.35 * SHIFT @ SHIFT  # free Gaussians: 0.13


@pytest.mark.slow
def test_frame_speed__measures_a_tiny_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_speed, "SIZES", {"tiny": frame_speed.Size(64, 48, 3, 600, 2)})
    out = tmp_path / "out.json"
    frame_speed.main(frame_speed.Options(out, ("tiny",), epochs=(1,), full=()))
    for run in read_json(out)["tiny"]["runs"].values():
        assert min(run["seconds"], run["bytes"], run["pixels"], run["psnr"] - 10) > 0


def test_host__counts_the_operations_of_a_frame_and_of_a_step(tmp_path):
    """In a process of its own, see `HostCounts`."""
    command = [sys.executable, "-m", "tests.benchmarks.count_host", str(tmp_path / "plot.png")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_pair_row__relates_each_run_to_the_base_that_ran_before_it():
    figures = np.array([[[2, 100], [1, 90]], [[4, 100], [3, 80]], [[10, 100], [2, 70]]])
    row = pairs.pair_row(figures)
    assert row["ratios"] == [0.5, 0.75, 0.2]
    assert row["ratio"] == 0.5
    assert row["seconds"] == [4, 2]
    assert row["memory"] == [100, 80]
    assert "| a | 0.50 | 0.20 to 0.75 | 4 | 2 | 100 | 80 |" in pairs.pairs_table({"a": row})


@pytest.mark.slow
def test_pairs__of_a_checkout_with_itself_have_seconds_and_memory(tmp_path):
    command = ["-m", "benchmarks.speed.pairs", ".", "--pairs", "2", "--cases", "splat tiny"]
    out = tmp_path / "pairs.json"
    subprocess.run([sys.executable, *command, "--json", str(out)], cwd=ROOT, check=True)
    (row,) = read_json(out)["pairs"].values()
    assert len(row["ratios"]) == 2
    assert min(*row["ratios"], *row["seconds"], *row["memory"]) > 0


@pytest.mark.slow
def test_pictures__are_drawn():
    loop = StreamLoop.of(recording(), CONFIG)
    frames = recording().partial_frames(0, CONFIG.motion.mask_interval + 1)
    *others, last = [frame.images for frame in frames]
    for images in others:
        loop.push(images)
    page = (Path(__file__).parents[2] / "docs/how-it-works.md").read_text(encoding="utf-8")
    assert set(pictures.draw(loop, last)) == set(re.findall(r"\(how-it-works/(\w+)\.jpg\)", page))
