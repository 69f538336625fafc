"""Time offsets of cameras from what moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morgs_mi import rasterize
from morgs_mi.calibration.timing import TimingConfig, estimate_time_offsets, time_step, time_sums
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.losses.ssim import Target
from morgs_mi.render.active_view import ActiveView
from morgs_mi.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.synth.synthesize import synthesize
from tests.scenes.ball import opaque_ball, views

# World units per frame, about a pixel.
MOTION = np.float32((0.04, 0.02, -0.01))


def test_time_step__finds_how_far_each_view_is_ahead() -> None:
    ball, sums = replace(opaque_ball(), motion=np.tile(MOTION, (400, 1))), []
    offsets = np.array([-0.5, -0.1, 0.2, 0.6])
    for camera, offset in zip(views(), offsets, strict=True):
        shown = replace(ball, means=np.asarray(ball.means) + np.float32(offset) * MOTION)
        image = np.clip(np.asarray(rasterize(shown, camera, ("color",)).color), 0, 1)
        sums.append(time_sums(ball, ActiveView(camera), Target(image)))
    found = time_step(np.array(sums))
    assert found is not None
    np.testing.assert_allclose(found, offsets, atol=0.05)


def test_time_step__leaves_a_view_without_motion_where_it_is() -> None:
    found = time_step(np.array([(3.0, 10.0), (1e-3, 1e-6)]))
    assert found is not None
    np.testing.assert_allclose(found, [0.3, 0.1], atol=1e-3)
    assert time_step(np.zeros((2, 2))) is None


def test_estimate_time_offsets__refuses_a_single_frame(textured_capture: Capture) -> None:
    with pytest.raises(ValueError, match="expected at least 4 frames to compare clocks, got 1; record longer"):
        estimate_time_offsets(textured_capture)


def test_timing_config__refuses_too_few_frames() -> None:
    with pytest.raises(ValueError, match=r"TimingConfig\(\): `frames` must be a number in \[4, inf\), got 3"):
        TimingConfig(frames=3)


@pytest.mark.slow
def test_estimate_time_offsets__finds_the_offsets_of_a_clip(tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    synthesize("spheres", clip, num_cameras=7, width=128, height=96, disturbances=Disturbances(time_offset=1.5))
    found = estimate_time_offsets(load_capture(clip))
    truth = {name: -camera.time_offset for name, camera in load_disturbances(clip / "truth").items()}
    assert found.reference == "cam00"
    # Things move by about a pixel per frame in images of 128 pixels.
    assert found.offsets == pytest.approx(truth, abs=0.15)
