"""Streams of HDR recordings: files of linear light, displays after an exposure."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import open_stream
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.core.color_space import SH_C0, TRANSFER, decode_light, display_image
from morgs_mi.io.exr import read_light
from morgs_mi.playback.export.frames import write_images
from morgs_mi.playback.player import render_stream
from morgs_mi.playback.stream_header import stream_exposure
from tests.scenes.surfaces import camera, cloud

STOPS = -2.5


def bright_cloud():
    gaussians = cloud(0.5)
    return replace(gaussians, sh_coeffs=gaussians.sh_coeffs + 1.2 / SH_C0)


def written(path, metadata):
    with StreamWriter(path, [camera()], 10, metadata) as writer:
        writer.write(keyframe_packet(bright_cloud(), 0))
    return path


@pytest.fixture
def stream(tmp_path):
    return open_stream(
        written(tmp_path / "s.morgs", {"transfer": {"name": TRANSFER, "display_exposure": STOPS}})
    )


def rendered(stream):
    return dict(render_stream(stream, camera(), ("color",)))[0]["color"]


def write(stream, path, stops=0.0):
    write_images(render_stream(stream, camera(), ("color",)), 10, path, display_exposure=stops)


def test_write_images__exr_files_have_the_light_of_the_curve(stream, tmp_path):
    write(stream, tmp_path / "a.exr")
    light = read_light(tmp_path / "a.exr")
    assert_allclose(light, decode_light(rendered(stream)), rtol=1e-5)
    assert light.max() > 4


def test_write_images__png_files_show_the_exposure(stream, tmp_path):
    write(stream, tmp_path / "a.png", stream_exposure(stream))
    shown = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    expected = display_image(decode_light(rendered(stream)), STOPS)
    assert np.abs(shown.astype(int) - expected).max() <= 1
    write(stream, tmp_path / "b.png", -20)
    assert cv2.imread(str(tmp_path / "b.png")).max() == 0


def test_write_images__streams_of_8_bits_are_clipped_as_they_are(tmp_path):
    stream = open_stream(written(tmp_path / "s.morgs", {}))
    assert stream_exposure(stream) == 0
    write(stream, tmp_path / "a.png", stream_exposure(stream))
    expected = (np.clip(rendered(stream), 0, 1) * 255 + 0.5).astype(np.uint8)
    assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], expected)
