"""Report on disturbances: a tiny clip."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.reports import disturbances
from benchmarks.reports.disturbances import CELLS, Options, disturbance_table
from tests.scenes.animated_gltf import write_glb


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    work = {"num_gaussians": 200, "first_frame_steps": 10, "epochs": 1, "cameras": 3, "width": 64, "frames": 2}
    work |= {"fit_seeds": (0, 1)}
    model = write_glb(tmp_path / "model.glb")
    disturbances.main(
        Options(json=tmp_path / "out.json", model=model, animation="bend", clips=tmp_path / "clips", **work)
    )
    found = json.loads((tmp_path / "out.json").read_text())
    assert list(found["disturbances"]) == list(CELLS)
    assert list(found["cells"]) == [f"{name}/{seed}" for name in CELLS for seed in (0, 1)]
    assert disturbance_table(found["cells"]).count("\n") == 2 + len(CELLS)
