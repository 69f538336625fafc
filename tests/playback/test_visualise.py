"""Visualisation: meaning of the colours, sizes of sheets, atomic files."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.playback import visualise
from morgs_mi.testing import assert_close


def test_motion_image__colours_are_as_documented():
    motion = np.array([[[0, 0], [2.5, 0], [5, 0], [-5, 0], [50, 0], [np.nan, 0]]])
    colours = visualise.motion_image(motion, 5.0)[0].tolist()
    assert colours[:2] == [[255, 255, 255], [255, 128, 128]]
    assert colours[2:] == [[255, 0, 0], [0, 255, 255], [255, 0, 0], [128, 128, 128]]
    down, up = visualise.motion_image(np.array([[[0, 5], [0, -5]]]), 5.0)[0]
    assert down.argmax() == 1
    assert up.argmax() == 2


def test_motion_image__is_over_the_grey_image():
    motion = np.array([[[0, 0], [2.5, 0], [5, 0], [np.nan, 0]]])
    color = np.array([[[255, 0, 0]] * 4], np.uint8)
    grey = round(0.299 * 255)
    half = round(grey / 2)
    colors = visualise.motion_image(motion, 5.0, color)[0].tolist()
    assert colors == [[grey] * 3, [half + 128, half, half], [255, 0, 0], [128, 128, 128]]


def test_motion_legend__agrees_with_the_image():
    legend = visualise.motion_legend(8.0, size=101)
    expected = visualise.motion_image(np.array([[[0.0, 6.4]]]), 8.0)[0, 0]
    assert_close(legend[90, 50].astype(int), expected, atol=2)
    assert (legend[-1, -1] == 255).all()


def test_error_image__is_black_without_an_error_and_one_sided():
    error = np.array([0, 0.02, 0.05, 0.1, 0.5])[None, :, None] * np.array([0.5, 1, 1.5])
    brightness = visualise.error_image(error).sum(-1, dtype=int)[0]
    assert brightness[0] < 10
    assert (np.diff(brightness[:4]) > 0).all()
    assert brightness[3] == brightness[4]


def test_depth_image__brightens_with_nearness_and_undefined_is_grey():
    depth = np.array([[1.0, 2.0, 10.0, 0.0, np.inf, np.nan]])
    image = visualise.depth_image(depth)[0].astype(int)
    assert (np.diff(image[:3].sum(-1)) < 0).all()
    assert (image[3:] == 128).all()
    assert (visualise.depth_image(np.zeros((2, 2))) == 128).all()
    assert np.unique(visualise.depth_image(np.ones((2, 2, 1)))[..., 0]).size == 1


def test_write_png__is_lossless_and_removes_its_output_after_a_failure(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (7, 9, 3), dtype=np.uint8)
    visualise.write_png(tmp_path / "new" / "image.png", image)
    assert_array_equal(cv2.imread(str(tmp_path / "new/image.png"))[..., ::-1], image)
    (tmp_path / "new" / "taken.png").mkdir()
    with pytest.raises(OSError, match=r"cannot write .*taken\.png"):
        visualise.write_png(tmp_path / "new" / "taken.png", image)
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["image.png", "taken.png"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: visualise.to_uint8(np.zeros((2, 2, 4))), r"to_uint8\(\).*got \(2, 2, 4\)"),
        (
            lambda: visualise.motion_image(np.zeros((2, 2, 2)), 0),
            r"motion_image\(\).*positive, got .* and 0",
        ),
    ],
)
def test_visualise__rejects_invalid_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
