"""Report on a recording: quality, times and memory of a fit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reports.real_capture import resident, summary
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video

ROOT = Path(__file__).parents[3]


def test_summary__adds_the_memory_to_the_scores(fitted_clip: Path, tmp_path: Path):
    for name in ("stream.morgs", "report.json"):
        (tmp_path / name).write_bytes((fitted_clip / name).read_bytes())
    rows = [{"frame": t, "resident_mib": 100.0 + t} for t in (0, 1)]
    (tmp_path / "memory.jsonl").write_text("\n".join(map(json.dumps, rows)))
    result = summary(tmp_path, fitted_clip / "capture")
    assert [row["resident_mib"] for row in result["frames"]] == [100, 101, None]
    assert [row["seconds"] for row in result["frames"]] == [3, 2, 1]
    assert (result["complete"], result["num_frames"], result["held_out"]) == (True, 3, True)
    assert result["views"]["cam0"].keys() == {"psnr", "ssim", "delta_e"}
    assert {"psnr", "psnr_moving", "psnr_still", "psnr_slope", "ssim", "mtv", "bytes", "playback"} <= result.keys()
    assert resident() > 50


@pytest.mark.slow
def test_real_capture__fits_and_measures_a_recording(tmp_path: Path):
    names, rng = ("cam0", "cam1"), np.random.default_rng(0)
    views = [Camera.look_at((i - 0.5, 0, -3), (0, 0, 0), (0, -1, 0), 60, 48, 32, name) for i, name in enumerate(names)]
    write_colmap(tmp_path / "clip" / "sparse" / "0", views, rng.uniform(-1, 1, (150, 3)), rng.uniform(size=(150, 3)))
    for name in names:
        write_video(tmp_path / "clip" / name, rng.integers(0, 255, (2, 32, 48, 3), np.uint8), 25)
    script, out = "benchmarks.reports.real_capture", tmp_path / "figures.json"
    quick = ["--fit.num-gaussians", "120", "--fit.first-frame-steps", "4", "--fit.epochs", "1", "--fit.sh-degree", "0"]
    args = [tmp_path / "clip", tmp_path / "out", "--json", out, *quick]
    subprocess.run([sys.executable, "-m", script, *map(str, args)], check=True, cwd=ROOT, capture_output=True)
    result = json.loads(out.read_text())
    assert (result["capture"], result["complete"], result["num_frames"]) == ("clip", True, 2)
    assert set(result["views"]) == set(names)
    assert all(row["resident_mib"] > 50 and row["seconds"] > 0 for row in result["frames"])
    assert str(tmp_path) not in out.read_text()
