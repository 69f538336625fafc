"""Motion models of other publications, times, and pictures, at a tiny size."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from benchmarks import ewa, pictures, workloads
from benchmarks.field import anchors, hicom, motion_grid, transformation_cache  # noqa: F401, they register models
from benchmarks.speed import (
    frame_speed,
    growth,
    render_speed,
    splat_files,
    stages,
    step_parts,
)
from morgs_mi.platform.bounded import read_json
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.gaussians import make_unit_scene, to_gaussians
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


def test_stages__have_all_seconds_of_a_frame(monkeypatch):
    monkeypatch.setattr(frame_speed, "SIZES", {"tiny": frame_speed.Size(64, 48, 3, 600, 2)})
    rows = stages.profile_scene("tiny", epochs=1)
    total = rows.pop("total")
    assert sum(row["seconds"] for row in rows.values()) == pytest.approx(total["seconds"], rel=0.02)
    assert rows["steps"]["passes"] == 2 * 3  # rendered and differentiated
    assert "| steps |" in stages.table({"tiny": rows | {"total": total}})


def test_host__counts_the_operations_of_a_frame_and_of_a_step(tmp_path):
    """In a process of its own, see `HostCounts`."""
    command = [sys.executable, "-m", "tests.benchmarks.count_host", str(tmp_path / "plot.png")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_growth__measures_a_tiny_scene():
    point = growth.measure(frame_speed.Size(64, 48, 3, 600, 2))
    assert point["pixels"] == 64 * 48
    assert min(point.values()) > 0
    assert growth.slope([1, 10], [2, 200]) == pytest.approx(2)


@pytest.mark.slow
def test_render_speed__compares_with_other_programs(tmp_path):
    program = tmp_path / "yardstick"
    program.write_text('#!/bin/sh\n[ -s "$1" ] && echo "fwd+bwd ms: median 0.5"')
    program.chmod(0o755)
    options = render_speed.Options(workload=tmp_path, yardstick=program, baselines=True)
    result = render_speed.figures(*workloads.ball(0, 60, 40, 24, 0.1), options)
    assert result["ratio_to_yardstick"] == pytest.approx(result["step_ms"] / 0.5, rel=1e-2)
    assert min(result["tenth_share"], result["volprim_step_ms"]) > 0


def test_step_parts__change_the_gradients_and_leave_the_renderer_as_it_was():
    scene = workloads.ball(0, 60, 40, 24, 0.1)

    def gradients(part):
        # A recording has the loops of its first call; each measurement has its own process.
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False), step_parts.without(part):
            return np.concatenate([np.ravel(g) for g in step_parts.work(*scene, part)()])

    whole = gradients("")
    for part in ("exponentials", "sums", "loads"):
        assert np.isfinite(gradients(part)).all()
        assert np.abs(gradients(part) - whole).max() > 0.01 * np.abs(whole).max()
        np.testing.assert_array_equal(gradients(""), whole)


@pytest.mark.slow
def test_step_parts__times_the_parts():
    scene = workloads.ball(0, 60, 40, 24, 0.1)
    for part in ("adjoint", "blending", "all blocks"):
        assert render_speed.timed(step_parts.work(*scene, part)) > 0


def test_splat_files__reports_times_and_sizes():
    assert min(splat_files.measure(200, width=64).values()) > 0


@pytest.mark.slow
def test_pictures__are_drawn(tmp_path):
    loop = StreamLoop.of(recording(), CONFIG)
    frames = recording().partial_frames(0, CONFIG.motion.mask_interval + 1)
    *others, last = [frame.images for frame in frames]
    for images in others:
        loop.push(images)
    page = (Path(__file__).parents[2] / "docs/how-it-works.md").read_text(encoding="utf-8")
    assert set(pictures.draw(loop, last)) == set(re.findall(r"\(how-it-works/(\w+)\.jpg\)", page))
    images = ewa.rendered(to_gaussians(make_unit_scene()), make_sensor_camera(), 16)
    assert ewa.write_picture(tmp_path / "ewa.jpg", images) > 25
