"""The model of larger clusters, and the measurement at a tiny size."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.speed import scaling
from benchmarks.speed.scaling import Costs, Options, Run
from morgs_mi.capture.capture import load_capture
from tests.scenes.recording import write_recording

ONE = Run(workers=1, seconds=100.0, start=3.0, common=10.0, seam=5.0, later=2.0, num_bytes=1000.0)
TWO = Run(workers=2, seconds=60.0, start=3.0, common=11.0, seam=5.5, later=2.2, num_bytes=1000.0)
COSTS = Costs(trip=0.01, read=0.0, client=0.01)


def test_efficiencies__compare_with_one_worker() -> None:
    one, two = scaling.efficiencies([ONE, TWO])
    assert (one["frames"], one["whole"]) == (1, 1)
    assert two["frames"] == pytest.approx(2.0 / 2.2)
    assert two["whole"] == pytest.approx(100 / 120)


def test_stages__of_frames_fall_with_the_workers_and_others_do_not() -> None:
    few, many = (scaling.stages(count, ONE, COSTS, 1.0, 1.0, Options(long_frames=1000)) for count in (2, 20))
    assert few["frames"] == pytest.approx(1000)
    assert many["frames"] == pytest.approx(100)
    assert few["client"] == many["client"]
    assert list(few) == [line.split()[0] for line in scaling.__doc__.splitlines() if line.startswith("    ")][1:]


def test_model__draws_every_number_of_workers(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="comes with the extra `notebooks`")
    capture = load_capture(write_recording(tmp_path / "clip", 2))
    rows = scaling.model([ONE, TWO], COSTS, capture, Options())
    assert [row["workers"] for row in rows] == [8, 64, 512]
    assert rows[-1]["bottleneck"] == "client"
    assert rows[0]["efficiency"] > rows[-1]["efficiency"]
    scaling.draw({"efficiency": scaling.efficiencies([ONE, TWO]), "model": rows}, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    size = {"cameras": 3, "frames": 6, "width": 64, "gaussians": 100, "first_frame_steps": 8, "epochs": 1}
    scaling.main(Options(json=tmp_path / "scaling.json", segments=2, **size))
    found = json.loads((tmp_path / "scaling.json").read_text())
    assert [run["workers"] for run in found["runs"]] == [1, 2]
    assert all(cost > 0 for cost in found["costs"].values())
