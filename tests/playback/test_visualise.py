"""Visualisation: meaning of the colours, sizes of sheets, atomic files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from morgs_mi.playback import visualise
from tests.assertions import assert_close


def test_motion_image__colours_are_as_documented():
    motion = np.array([[[0, 0], [5, 0], [-5, 0], [50, 0], [np.nan, 0]]])
    colours = visualise.motion_image(motion, 5.0)[0].tolist()
    assert colours == [[255, 255, 255], [255, 0, 0], [0, 255, 255], [255, 0, 0], [128, 128, 128]]
    down, up = visualise.motion_image(np.array([[[0, 5], [0, -5]]]), 5.0)[0]
    assert down.argmax() == 1
    assert up.argmax() == 2


def test_motion_image__saturation_increases_with_speed():
    speeds = np.linspace(0, 10, 11)
    green = visualise.motion_image(np.stack([speeds, 0 * speeds], -1)[None], 10)[0, :, 1].astype(
        int
    )
    assert (np.diff(green) < 0).all()


def test_motion_legend__agrees_with_the_image():
    legend = visualise.motion_legend(8.0, size=101)
    expected = visualise.motion_image(np.array([[[0.0, 6.4]]]), 8.0)[0, 0]
    assert_close(legend[90, 50].astype(int), expected, atol=2)
    assert (legend[-1, -1] == 255).all()


def test_confidence_image__brightens_with_confidence():
    ramp = visualise.confidence_image(np.linspace(0, 1, 8)[None, :, None])
    assert (np.diff(ramp.sum(-1, dtype=int)[0]) > 0).all()


def test_grey_image__is_the_mean_of_the_components():
    values = np.linspace(0, 1, 8)[None, :, None]
    np.testing.assert_array_equal(visualise.grey_image(values), visualise.to_uint8(values))
    np.testing.assert_array_equal(visualise.grey_image(values[..., 0]), visualise.to_uint8(values))
    assert (visualise.grey_image(np.tile([0, 0, 0.4, 0.4], (2, 3, 1))) == 51).all()


def test_confidence_legend__agrees_with_the_image():
    legend = visualise.confidence_legend(size=90)
    for row, value in ((0, 1.0), (89, 0.0)):
        assert (legend[row, :30] == visualise.confidence_image(np.array([[value]]))[0, 0]).all()
    assert (legend[:, 89] == 255).all()


def test_time_slice__time_increases_to_the_right():
    columns = [np.full((5, 3), 10 * t, np.uint8) for t in range(4)]
    columns[2][3] = 255
    sliced = visualise.time_slice(columns, least_width=8)
    assert sliced.shape == (5, 8, 3)
    assert sliced[0, :, 0].tolist() == [0, 0, 10, 10, 20, 20, 30, 30]
    assert (sliced == 255).all(-1).nonzero()[1].tolist() == [4, 5]
    assert visualise.time_slice(columns * 100).shape == (5, 400, 3)


def test_depth_image__near_is_red_far_is_blue_undefined_is_grey():
    depth = np.array([[1.0, 2.0, 10.0, 0.0, np.inf, np.nan]])
    red, _, blue, *undefined = visualise.depth_image(depth)[0].astype(int)
    assert red[0] > red[2]
    assert blue[2] > blue[0]
    assert (np.array(undefined) == 128).all()
    assert (visualise.depth_image(np.zeros((2, 2))) == 128).all()
    assert np.unique(visualise.depth_image(np.ones((2, 2, 1)))[..., 0]).size == 1


def test_contact_sheet__pads_images_to_common_sizes():
    a = np.zeros((10, 20, 3), np.uint8)
    b = np.ones((30, 5))
    assert visualise.side_by_side([a, b]).shape == (30, 29, 3)
    sheet = visualise.contact_sheet([[a, b], [a]])
    assert sheet.shape == (44, 29, 3)
    assert (sheet[35:44, 25:] == 255).all()


def test_label__fits_any_size():
    for size in ((1, 1), (20, 30), (480, 640)):
        image = np.full((*size, 3), 0.5)
        labelled = visualise.label(image, "frame 12")
        assert labelled.shape == (*size, 3)
        assert (labelled != visualise.to_uint8(image)).any()


def test_write_png__round_trip(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (7, 9, 3), dtype=np.uint8)
    path = tmp_path / "new" / "image.png"
    visualise.write_png(path, image)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], image)
    assert [p.name for p in path.parent.iterdir()] == ["image.png"]


def test_write_png__removes_its_output_after_a_failure(tmp_path):
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(OSError, match=r"cannot write .*taken\.png"):
        visualise.write_png(tmp_path / "taken.png", np.zeros((2, 2)))
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"cannot write .*a\.png"):
        visualise.write_png(tmp_path / "file" / "a.png", np.zeros((2, 2)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "taken.png"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: visualise.to_uint8(np.zeros((2, 2, 4))), r"to_uint8\(\).*got \(2, 2, 4\)"),
        (lambda: visualise.motion_image(np.zeros((2, 2)), 1), r"motion_image\(\).*\[H, W, 2\]"),
        (
            lambda: visualise.motion_image(np.zeros((2, 2, 2)), 0),
            r"motion_image\(\).*positive, got .* and 0",
        ),
    ],
)
def test_visualise__rejects_invalid_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
