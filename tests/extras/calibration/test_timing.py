"""Time offsets of cameras from what moves."""

from dataclasses import replace

import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.view import Views
from morgs_mi.extras.calibration.timing import estimate_time_offsets
from morgs_mi.extras.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize


def test_estimate_time_offsets__refuses_a_single_frame(textured_capture):
    with pytest.raises(
        ValueError, match="expected at least 4 frames to compare clocks, got 1; record longer"
    ):
        estimate_time_offsets(textured_capture)


def test_estimate_time_offsets__refuses_a_single_camera(textured_capture):
    alone = replace(textured_capture, views=Views(textured_capture.views[:1]))
    with pytest.raises(ValueError, match="expected at least 2 cameras to compare clocks, got 1"):
        estimate_time_offsets(alone)


@pytest.mark.long
def test_estimate_time_offsets__finds_the_offsets_of_a_clip(tmp_path):
    clip = tmp_path / "clip"
    synthesize(
        "spheres",
        clip,
        SynthConfig(cameras=7, width=128, height=96, disturbances=Disturbances(time_offset=1.5)),
    )
    estimate = estimate_time_offsets(load_capture(clip))
    truth = {
        name: -camera.time_offset for name, camera in load_disturbances(clip / "truth").items()
    }
    assert estimate.reference == "cam00"
    # Things move by about a pixel per frame in images of 128 pixels.
    assert estimate.offsets == pytest.approx(truth, abs=0.15)
    assert all(error < 0.1 for error in estimate.errors.values())
    second_estimate = estimate_time_offsets(
        load_capture(clip, reading=ReadConfig(offset=estimate.offsets))
    )
    assert second_estimate.offsets == pytest.approx(truth, abs=0.15)
