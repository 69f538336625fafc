"""Efficiency of fits over workers, and the measurement at a tiny size."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.speed import scaling
from benchmarks.speed.scaling import Options, Run

ONE = Run(workers=1, seconds=100.0, start=3.0, common=10.0, seam=5.0, later=2.0, num_bytes=1000.0)
TWO = Run(workers=2, seconds=60.0, start=3.0, common=11.0, seam=5.5, later=2.2, num_bytes=1000.0)


def test_efficiencies__compare_with_one_worker() -> None:
    one, two = scaling.efficiencies([ONE, TWO])
    assert (one["frames"], one["whole"]) == (1, 1)
    assert two["frames"] == pytest.approx(2.0 / 2.2)
    assert two["whole"] == pytest.approx(100 / 120)


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    size = {
        "cameras": 3,
        "frames": 6,
        "width": 64,
        "gaussians": 100,
        "first_frame_steps": 8,
        "epochs": 1,
    }
    scaling.main(Options(json=tmp_path / "scaling.json", segments=2, **size))
    output = json.loads((tmp_path / "scaling.json").read_text())
    assert [run["workers"] for run in output["runs"]] == [1, 2]
    assert output["efficiency"][0]["whole"] == 1
