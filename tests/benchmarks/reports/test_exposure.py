"""Report on exposures: a tiny clip."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.reports import exposure
from benchmarks.reports.exposure import Options, exposure_table


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    work = {"num_gaussians": 200, "first_frame_steps": 10, "epochs": 1, "width": 64, "frames": 3}
    options = Options(json=tmp_path / "out.json", seeds=(3,), fit_seeds=(0, 1), clips=tmp_path / "clips", **work)
    exposure.main(options)
    found = json.loads((tmp_path / "out.json").read_text())
    groups = ["3 equal off", "3 equal auto", "3 disturbed off", "3 disturbed auto"]
    assert list(found["fits"]) == [f"{group} {seed}" for group in groups for seed in (0, 1)]
    assert exposure_table(found["fits"]).count("\n") == 5
