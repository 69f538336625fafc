"""The demonstration in small: everything that it promises is there, and agrees with itself."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from morgs_mi.config import StreamConfig
from morgs_mi.demo import Clip, DemoConfig, _clip, run_demo
from morgs_mi.fit.config import FitConfig

SMALL = DemoConfig(
    clip=Clip(num_cameras=6, num_frames=4, width=64, height=48, spp=4),
    plain_frames=3,
    stream=StreamConfig(fit=FitConfig(sh_degree=0, num_gaussians=500, first_frame_steps=40, epochs=1)),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    stages: list[str] = []
    run_demo(folder, SMALL, lambda stage, done, total: stages.append(stage))
    assert list(dict.fromkeys(stages))[:3] == ["Path-tracing the clip", "Fitting", "Fitting without ML, MO, MC"]
    return folder


def test_figures(out: Path) -> None:
    report = json.loads((out / "report.json").read_text())
    assert (report["full"]["num_frames"], report["plain"]["num_frames"]) == (4, 3)
    assert report["comparison"]["frames"] == [1, 2], "nothing moves in the first frame; the third has no twin"
    rows = report["full"]["frames"][1:3]
    mean = sum(row["motion_error_moving"] for row in rows) / 2
    assert report["comparison"]["full"]["motion_error_moving"] == pytest.approx(mean)
    assert report["full"]["held_out"]
    assert report["full"]["bytes"]["file"] == (out / "stream" / "stream.morgs").stat().st_size
    assert {"machine", "versions", "seed", "seconds"} <= set(report)


def test_pictures(out: Path) -> None:
    video = cv2.VideoCapture(str(out / "side_by_side.mp4"))
    assert [video.read()[1].shape for _ in range(4)] == [(48, 4 * 64 + 3 * 4, 3)] * 4
    assert not video.read()[0]
    # Three frames and one of the plain fit; six columns and, below, the legend in place of the last.
    assert cv2.imread(str(out / "contact_sheet.png")).shape[0] == 3 * (48 + 4) + max(48, 96)


def test_a_clip_is_made_again_only_if_it_differs(out: Path) -> None:
    marker = out / "capture" / "marker"
    marker.write_text("kept")
    _clip(out / "capture", SMALL, lambda done, total: None)
    assert marker.exists()
    _clip(out / "capture", replace(SMALL, clip=replace(SMALL.clip, num_frames=1)), lambda done, total: None)
    assert not marker.exists()
