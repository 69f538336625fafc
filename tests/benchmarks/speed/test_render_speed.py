"""The speed benchmark of the renderer: figures, yardstick and baselines."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import workloads
from benchmarks.speed import timing

ROOT = Path(__file__).parents[3]
# Output of a yardstick, from a program that checks its input: 60 Gaussians on 40x24 pixels.
YARDSTICK = """#!/bin/sh
[ "$(wc -c < "$1")" = $((3 * 4 + 60 * 14 * 4 + 25 * 4 + 6 * 4)) ] || exit 1
[ "$2" = 9 ] && [ "$3" -ge 1 ] || exit 1
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


def test_yardstick__passes_the_workload_and_reads_the_median(workload: Path, yardstick: Path):
    gaussians, camera = workloads.load(workload)
    assert timing.Yardstick(yardstick).step(gaussians, camera, 9) == 0.5


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
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert json.loads(done.stdout) == result
    for stage in ("step_ms", "tenth_step_ms", "tenth_share"):
        assert result[stage] > 0, stage
    assert result["yardstick_step_ms"] == 0.5
    assert result["ratio_to_yardstick"] == pytest.approx(result["step_ms"] / 0.5, rel=1e-2)
    assert (result["gaussians"], result["size"], result["workload"]) == (60, [40, 24], "tiny.npz")
    assert {"machine", "versions", "commit"} <= result.keys()


@pytest.mark.slow
def test_render_speed__times_baselines(workload: Path):
    done = run("--workload", workload, "--baselines")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["volprim_step_ms"] > 0
