"""A held-out camera that stands in a dark ball, as cameras on the wall of a dome do in the views of
the others.
"""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.fit.initialise import from_points
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import to_uint8, write_png
from morgs_mi.render.rasterize import rasterize
from morgs_mi.runs.fit_capture import stream_capture
from tests.quick import quick
from tests.scenes.cameras import circle, look_at_cameras

RADIUS = 0.08  # of the dark ball around camera 0


def dome():
    """Return eight cameras on a circle, of which the opposite ones see camera 0 above the scene."""
    return look_at_cameras(circle(np.arange(8) * np.pi / 4, 3.0, z=0.9), 60, 96, 72, up=(0, 0, 1))


def scene():
    """Return points and colours of a bright cube in the middle and a dark ball around camera 0."""
    rng = np.random.default_rng(0)
    cube = rng.uniform(-0.8, 0.8, (400, 3))
    ball = rng.normal(size=(60, 3))
    ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    colors = np.concatenate([0.6 + 0.3 * np.sin(5 * cube), np.full((60, 3), 0.02)])
    return np.concatenate([cube, dome()[0].position + ball]), colors


def splats():
    points, colors = scene()
    gaussians = from_points(points, colors, 0, opacity=0.9)
    dark = np.arange(len(points)) >= 400
    log_scales = np.where(dark[:, None], np.log(RADIUS / 2), np.asarray(gaussians.log_scales))
    return replace(gaussians, log_scales=log_scales)


def image(camera, gaussians):
    return to_uint8(
        np.asarray(rasterize(gaussians, camera, ("color",), background=(0.5, 0.5, 0.5)).color)
    )


@pytest.fixture
def capture(tmp_path):
    """A capture whose camera 0, held out, has photographed the scene without the ball around
    itself.
    """
    path = tmp_path / "capture"
    write_colmap(path / "sparse" / "0", dome(), *scene())
    for index, camera in enumerate(dome()):
        gaussians = splats() if index else splats().select(np.arange(400))
        write_png(path / camera.name / "0000.png", image(camera, gaussians))
    return path


def test_load_capture__near_plane_is_behind_a_splat_around_a_held_out_camera(capture):
    camera = load_capture(capture).cameras[0]
    shown, true = (image(camera, s) for s in (splats(), splats().select(np.arange(400))))
    assert np.array_equal(shown, true)
    assert image(replace(camera, near=0.01), splats()).max() < 60, (
        "the test has no splat around the camera"
    )


@pytest.mark.slow
def test_load_capture__takes_a_given_near_plane_and_the_stream_stores_it(capture, tmp_path):
    stream_capture(load_capture(capture, reading=ReadConfig(near=0.3)), tmp_path / "out", quick())
    assert {camera.near for camera in open_stream(tmp_path / "out").cameras} == {0.3}


def test_capture__keeps_near_planes_at_the_recorded_size(capture):
    reading = ReadConfig(near=0.3)
    recording = load_capture(capture, downscale=2, reading=reading)
    assert {camera.near for camera in recording.cameras} == {0.3}
    assert {camera.near for camera in recording.at_recorded_size().cameras} == {0.3}


@pytest.mark.parametrize("near", [0.0, float("inf")])
def test_load_capture__refuses_a_near_plane_that_is_not_positive(capture, near):
    with pytest.raises(ValueError, match="`near` must"):
        load_capture(capture, reading=ReadConfig(near=near))
