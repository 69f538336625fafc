"""Memory of reading a long capture."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.speed import capture_memory

ROOT = Path(__file__).parents[3]


def test_measure__reports_memory_and_time_by_frame():
    options = capture_memory.Options(cameras=2, frames=4, width=64, height=48, downscale=1)
    result = capture_memory.measure(options)
    assert [row["frame"] for row in result["rows"]] == [0, 1, 2, 3]
    assert result["largest_mib"] >= result["settled_mib"] > 10
    assert result["frame_mib"] == 2 * 64 * 48 * 3 / 2**20
    assert result["seconds_per_frame"] > 0


@pytest.mark.slow
def test_capture_memory__does_not_grow_with_the_clip(tmp_path: Path):
    """A few of 60 frames of 2.6 MiB are in memory at a time; storing all of them would exceed the bound."""
    script, out = "benchmarks.speed.capture_memory", tmp_path / "memory.json"
    sizes = ["--cameras", "3", "--frames", "60", "--width", "640", "--height", "480", "--downscale", "1"]
    command = [sys.executable, "-m", script, "--json", str(out), *sizes]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
    result = json.loads(out.read_text())
    assert len(result["rows"]) == 30
    assert result["growth_mib"] < 6 * result["frame_mib"]
