"""Images of 16 bits that hold the values of cameras of fewer."""

import cv2
import numpy as np
import pytest

from morgs_mi.io.video import open_clips


@pytest.mark.parametrize(
    ("most", "shown", "note"),
    [
        ([4095, 900], [255, 56], "values up to 4095 and are read as 12 bits"),
        ([0, 1000, 1023], [0, 249, 255], "read as 10 bits"),
        ([16000, 2000], [249, 31], "read as 14 bits"),
        ([250, 255], [250, 255], "read as 8 bits"),
        ([3000, 900], [12, 4], "values up to 3000 of 65535 and are nearly black"),
        ([16383, 4095], [64, 16], "up to 16383 of 65535"),
        ([51400, 4095], [200, 16], ""),
    ],
)
def test_open_clips__scales_the_bits_of_cameras_or_names_dark_images(
    tmp_path, caplog, most, shown, note
):
    for camera, value in enumerate(most):
        (tmp_path / str(camera)).mkdir()
        image = np.full((32, 48, 3), value, np.uint16)
        cv2.imwrite(str(tmp_path / str(camera) / "0.png"), image)
    readers = open_clips([tmp_path / str(camera) for camera in range(len(most))])
    assert [next(reader.frames())[0, 0, 0] for reader in readers] == shown
    assert note in caplog.text
    assert bool(note) == bool(caplog.text)


def test_open_clips__refuses_later_values_above_the_bits_of_cameras(tmp_path):
    for frame, value in enumerate((4095, 5000)):
        image = np.full((32, 48), value, np.uint16)
        cv2.imwrite(str(tmp_path / f"{frame}.png"), image)
    (reader,) = open_clips([tmp_path])
    with pytest.raises(ValueError, match=r"1\.png: expected values up to 4095 .* got 5000"):
        list(reader.frames())


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_open_clips__refuses_images_that_have_neither_8_nor_16_bits(tmp_path, dtype):
    cv2.imwrite(str(tmp_path / "0.tif"), np.full((32, 48, 3), 9, dtype))
    with pytest.raises(ValueError, match=r"0\.tif: expected 8 or 16 bits"):
        open_clips([tmp_path])
