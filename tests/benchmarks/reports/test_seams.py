"""Report on seams: a tiny clip."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.reports import seams
from benchmarks.reports.seams import Options, seam_table

SIZE = {"cameras": 3, "width": 48, "gaussians": 80, "first_frame_steps": 8, "epochs": 1, "segment_frames": 2}


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    seams.main(Options(tmp_path / "seams.json", clips=(("spheres", 0, 4),), folder=tmp_path, **SIZE))
    found = json.loads((tmp_path / "seams.json").read_text())
    ((clip,), (seam,)) = found["clips"], found["clips"][0]["seams"]
    assert (clip["scene"], clip["frames"], seam["frame"], seam["whole"]["frame"]) == ("spheres", 4, 2, 2)
    assert seam_table([clip]).count("\n") == 3
