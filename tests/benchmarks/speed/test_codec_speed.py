"""The speed benchmark of the codec: times, bytes and error."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.speed import codec_speed

ROOT = Path(__file__).parents[3]


def check(row: dict) -> None:
    assert (row["gaussians"], row["moving"]) == (300, 100)
    assert min(row["encode_ms"], row["decode_ms"]) > 0
    # At least a flag and some bits for each of the numbers that change.
    assert 100 * 20 / 8 < row["bytes"] < 300 * 100
    # A step of 0.08 px in each of three directions.
    assert 0 < row["error_px_rms"] < row["error_px_max"] < 0.08 * 3**0.5


def test_measure__reports_times_bytes_and_error():
    check(codec_speed.measure(300, 100, repeats=1))


@pytest.mark.slow
def test_codec_speed__writes_one_row_per_size(tmp_path: Path):
    out, tool = tmp_path / "out.json", "benchmarks.speed.codec_speed"
    command = [sys.executable, "-m", tool, "--json", out, "--sizes", "300", "100", "--repeats", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["rows"]
    check(row)
