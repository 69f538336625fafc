"""Report on clocks that are apart: a tiny clip."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.reports import timing
from benchmarks.reports.timing import Options, timing_table


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    work = {
        "num_gaussians": 200,
        "first_frame_steps": 10,
        "epochs": 1,
        "width": 64,
        "frames": 6,
        "fitted": 2,
        "fit_seeds": (0,),
    }
    options = Options(json=tmp_path / "out.json", seeds=(3,), clips=tmp_path / "clips", time_offset=0.4, **work)
    timing.main(options)
    found = json.loads((tmp_path / "out.json").read_text())
    assert list(found["scenes"]) == ["random 3"]
    assert timing_table(found["scenes"]).count("\n") == 3
