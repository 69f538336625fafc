"""Images of other formats than PNG and JPEG."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.masks import opaque_pixels
from morgs_mi.io.images import FolderReader

RGB = np.random.default_rng(0).integers(0, 256, (37, 53, 3)).astype(np.uint8)
RGBA = np.dstack(
    [RGB, np.where(np.arange(53) < 20, 0, 255).astype(np.uint8) + np.zeros((37, 1), np.uint8)]
)


@pytest.mark.parametrize("suffix", [".TIFF", ".webp", ".BMP", ".JPEG"])
def test_folder_reader__reads_every_format_and_upper_case(tmp_path, suffix):
    for t in range(2):
        image = np.full((40, 60, 3), 100 + t, np.uint8)
        (tmp_path / f"{t}{suffix}").write_bytes(cv2.imencode(suffix.lower(), image)[1].tobytes())
    reader = FolderReader.open(tmp_path)
    assert [round(image.mean()) for image in reader.frames()] == [100, 101]
    assert opaque_pixels(reader, "cam") == (None, [])


@pytest.mark.parametrize("suffix", [".tif", ".webp", ".png"])
def test_folder_reader__masks_transparent_pixels_of_every_format(tmp_path, suffix):
    file = tmp_path / f"0{suffix}"
    file.write_bytes(cv2.imencode(suffix, RGBA)[1].tobytes())
    mask, (note,) = opaque_pixels(FolderReader.of_files([file]), "cam")
    assert "cam" in note
    assert_array_equal(mask, RGBA[..., 3] == 255)


def test_folder_reader__decodes_no_png_whose_chunks_claim_more_than_the_file(tmp_path):
    """OpenCV would allocate the claimed length, up to 4 GB."""
    data = bytearray(cv2.imencode(".png", RGB)[1].tobytes())
    at = data.find(b"IDAT") - 4
    data[at : at + 4] = b"\x7f\xff\xff\xff"
    (tmp_path / "0.png").write_bytes(data)
    with pytest.raises(ValueError, match=r"0.png: expected an image, got \d+ bytes that are none"):
        FolderReader.of_files([tmp_path / "0.png"])
