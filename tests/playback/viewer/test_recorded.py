"""Recorded images beside the render."""

from __future__ import annotations

import numpy as np

from morgs_mi.capture.capture import load_capture
from morgs_mi.playback.viewer.recorded import RecordedImages, seen_from, wipe
from tests.assertions import assert_close
from tests.scenes.cameras import make_camera, make_wide_camera
from tests.scenes.captures import n3dv


def test_recorded_images__in_any_order(tmp_path):
    recorded = RecordedImages(load_capture(n3dv(tmp_path / "capture")))
    for view, frame in ((0, 1), (0, 1), (0, 2), (2, 2), (2, 0), (0, 3), (0, 1)):
        image = recorded.at(view, frame)
        assert image is not None
        assert image[0, 0].tolist()[:2] == [view, frame]
    assert recorded.at(0, 9) is None
    assert recorded.num_frames == 4


def test_recorded_images__a_missing_image_is_none(tmp_path):
    path = n3dv(tmp_path / "capture")
    recorded = RecordedImages(load_capture(path))
    for clip in path.glob("cam00*"):
        clip.write_bytes(clip.read_bytes()[:-200])
    assert any(recorded.at(0, frame) is None for frame in range(4))


def test_seen_from__maps_every_pixel_to_its_ray():
    camera, view = make_wide_camera(), make_camera(60, 40)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x, y], -1)
    _, directions = camera.rays(pixels)
    seen = seen_from(view, camera, np.uint8(np.rint(127 + 127 * directions)))
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    _, expected = view.rays(np.stack([x, y], -1))
    inside, depth = camera.project(view.position + expected)
    margin = 2.0
    known = ((inside > margin) & (inside < np.array([camera.width, camera.height]) - margin)).all(-1) & (depth > 0)
    assert 0.2 < known.mean() <= 1
    assert_close(seen[known] / 127 - 1, expected[known], atol=0.02)


def test_seen_from__is_dark_grey_beyond_the_image():
    camera = make_wide_camera()
    wider = camera.look_at(camera.position, (0, 0, 0), (0, -1, 0), 100, 101, 75)
    seen = seen_from(wider, camera, np.full((75, 101, 3), 255, np.uint8))
    assert seen[0, 0].tolist() == [40, 40, 40]
    assert seen[37, 50].tolist() == [255, 255, 255]


def test_wipe__has_the_recorded_image_at_the_left():
    recorded, rendered = np.full((60, 200, 3), 10, np.uint8), np.full((60, 200, 3), 90, np.uint8)
    image = wipe(recorded, rendered, 0.3)
    assert (image[40:, :58] == 10).all()
    assert (image[40:, 62:] == 90).all()
    assert (image[40:, 60] == 255).all()
    assert (wipe(recorded, rendered, 1.0)[40:, :198] == 10).all()
    assert (wipe(recorded, rendered, 0.0)[40:] == 90).all()
