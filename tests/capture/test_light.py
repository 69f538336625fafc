"""Captures of EXR files, which have linear light."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.interpolation import FrameInterpolation
from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import Lens
from morgs_mi.core.color_space import TRANSFER, display_image
from morgs_mi.io.exr import write_exr
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.visualise import write_png
from morgs_mi.runs.fit_files import stream_metadata
from tests.scenes.captures import HEIGHT, WIDTH, rig

NAMES = ("cam01", "cam02")


PINHOLE = Lens()


def light(camera, frame):
    rng = np.random.default_rng([camera, frame])
    image = 0.5 * rng.random((HEIGHT, WIDTH, 3), np.float32)
    image[: HEIGHT // 4] *= 16
    return image


def recorded(path, alpha=None, lens=PINHOLE):
    images = [CalibratedImage(camera, lens) for camera in rig(NAMES, shift=3.0)]
    write_colmap(path / "sparse" / "0", images)
    for camera, name in enumerate(NAMES):
        (path / name).mkdir(parents=True)
        for frame in range(2):
            image = light(camera, frame)
            channels = {c: image[..., k] for k, c in enumerate("RGB")}
            channels |= {} if alpha is None else {"A": alpha}
            write_exr(path / name / f"{frame:04d}.exr", channels)
    return path


def test_load_capture__reads_sequences_of_exr_files(tmp_path):
    capture = load_capture(recorded(tmp_path))
    for t, frame in enumerate(capture.frames()):
        for camera, image in enumerate(frame.images):
            assert_array_equal(image, light(camera, t))
    white = np.percentile([light(camera, 0).max(axis=-1) for camera in range(2)], 99)
    assert capture.display_exposure == pytest.approx(-np.log2(white))
    shown = next(capture.displayed().frames()).images[0]
    assert_array_equal(shown, display_image(light(0, 0), capture.display_exposure))
    (tmp_path / "capture.json").write_text('{"display_exposure": -2}')
    assert load_capture(tmp_path).display_exposure == -2


def test_load_capture__masks_transparent_pixels_of_exr_files(tmp_path):
    alpha = np.ones((HEIGHT, WIDTH))
    alpha[:, : WIDTH // 2] = 0.9
    capture = load_capture(recorded(tmp_path, alpha))
    for mask in capture.masks:
        assert_array_equal(mask, alpha == 1)
    assert "cam01: 50.0 % of its pixels are transparent and masked out." in capture.notes


def test_load_capture__prefers_images_of_8_bits_to_exr_files_beside_them(tmp_path):
    recorded(tmp_path)
    for name in NAMES:
        for frame in range(2):
            write_png(
                tmp_path / name / f"{frame:04d}.png", np.full((HEIGHT, WIDTH, 3), 9, np.uint8)
            )
    capture = load_capture(tmp_path)
    assert capture.display_exposure is None
    assert next(capture.frames()).images[0].dtype == np.uint8


def test_process__averages_light_when_it_downscales(tmp_path):
    capture = load_capture(recorded(tmp_path))
    small = capture.cameras[0].resized(WIDTH // 2, HEIGHT // 2)
    blocks = light(0, 0).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    smaller = capture.views[0].with_camera(small)
    assert_allclose(smaller.process(light(0, 0)), blocks, rtol=1e-5)


def test_process__keeps_light_positive_through_undistortion(tmp_path):
    lens = Lens("SIMPLE_RADIAL", (0.05,))
    image = next(load_capture(recorded(tmp_path, lens=lens)).frames()).images[0]
    assert image.min() >= 0
    assert image.max() > 4


def test_frame_interpolation__of_equal_images_is_the_image():
    image = light(0, 0)
    assert_allclose(FrameInterpolation(image, image).at(0.5), image, rtol=1e-4, atol=1e-6)


def test_partial_frames__leave_out_a_broken_file(tmp_path):
    broken = recorded(tmp_path) / "cam02" / "0001.exr"
    broken.write_bytes(broken.read_bytes()[:900])
    _, frame = load_capture(tmp_path).partial_frames()
    assert frame.images[1] is None
    assert "cam02/0001.exr" in frame.problems[0]
    assert "the file may be truncated" in frame.problems[0]


def test_stream_metadata__names_the_transfer_of_light_alone(tmp_path):
    capture = load_capture(recorded(tmp_path))
    first = next(capture.partial_frames())
    transfer = stream_metadata(capture, first, StreamConfig())["transfer"]
    assert transfer == {"name": TRANSFER, "display_exposure": capture.display_exposure}
    shown = capture.displayed()
    assert "transfer" not in stream_metadata(shown, next(shown.partial_frames()), StreamConfig())
