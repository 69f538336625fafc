"""The speed benchmark of the renderer: figures, yardstick and baselines."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import workloads
from benchmarks.speed import render_speed, timing

ROOT = Path(__file__).parents[3]
# Output of a yardstick, from a program that checks its input: 60 Gaussians on 40x24 pixels.
YARDSTICK = """#!/bin/sh
[ "$(wc -c < "$1")" = $((3 * 4 + 60 * 14 * 4 + 25 * 4 + 6 * 4)) ] || exit 1
[ "$2" = 2 ] && [ "$3" -ge 1 ] || exit 1
echo "forward ms: median 1.0"
echo "fwd+bwd ms: median 0.5 min 0.4"
"""


@pytest.fixture
def yardstick(tmp_path: Path) -> Path:
    """A program that prints fixed times."""
    path = tmp_path / "yardstick"
    path.write_text(YARDSTICK)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def run(*args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.speed.render_speed", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


@pytest.mark.slow
def test_figures__are_times_memory_and_error(workload: Path):
    options = render_speed.Options(workload, repeats=1, rounds=2)
    result = render_speed.figures(*workloads.load(workload), options)
    for stage in (
        "lists_ms",
        "forward_ms",
        "adjoint_ms",
        "step_ms",
        "loss_ms",
        "peak_megabytes",
        "pairs",
    ):
        assert result[stage] > 0, stage
    assert result["tenth_share"] > 0
    assert result["error_rms"] <= result["error_max"] < 2e-4
    assert not any("yardstick" in name for name in result)


def test_yardstick__passes_the_workload_and_reads_the_median(workload: Path, yardstick: Path):
    gaussians, camera = workloads.load(workload)
    assert timing.Yardstick(yardstick).step(gaussians, camera, 2) == 0.5


def test_baselines__are_omitted_for_large_workloads(workload: Path):
    gaussians, camera = workloads.load(workload)
    works, omitted = timing.baselines(gaussians, camera.resized(1024, 768))
    assert works == {}
    assert set(omitted) == {"volprim"}


@pytest.mark.slow
def test_render_speed__compares_a_workload_with_a_yardstick(
    workload: Path, yardstick: Path, tmp_path: Path
):
    out = tmp_path / "out.json"
    done = run(
        "--workload",
        workload,
        "--json",
        out,
        "--yardstick",
        yardstick,
        "--repeats",
        2,
        "--rounds",
        1,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert json.loads(done.stdout) == result
    for stage in ("lists_ms", "forward_ms", "step_ms", "peak_megabytes", "pairs"):
        assert result[stage] > 0, stage
    assert result["yardstick_step_ms"] == 0.5
    assert result["ratio_to_yardstick"] == pytest.approx(result["step_ms"] / 0.5, rel=1e-2)
    assert len(result["ratio_per_round"]) == 1
    assert result["error_rms"] <= result["error_max"] < 2e-4
    assert (result["gaussians"], result["size"], result["workload"]) == (60, [40, 24], "tiny.npz")
    assert {"machine", "versions", "variant", "threads"} <= result.keys()


@pytest.mark.slow
def test_render_speed__times_baselines(workload: Path):
    done = run("--workload", workload, "--baselines", "--repeats", 1, "--rounds", 1)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    for name in ("volprim_forward_ms", "volprim_step_ms", "ratio_to_volprim"):
        assert result[name] > 0, name
