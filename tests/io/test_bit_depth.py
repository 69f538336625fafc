"""Images and videos of 16 bits that may hold the values of cameras with fewer."""

import cv2
import numpy as np
import pytest

from morgs_mi.io.clip_readers import open_clips
from tests.scenes.captures import write_timed_video


def write_camera(path, kind, values):
    """Write grey images of 16 bits as files, or as a lossless video."""
    images = [np.full((32, 48), value, np.uint16) for value in values]
    if kind == "video":
        write_timed_video(path, images, range(0, 40 * len(values), 40), layout="gray16le")
        return
    path.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(path / f"{i}.png"), image)


@pytest.mark.parametrize("kind", ["images", "video"])
@pytest.mark.parametrize(
    ("most", "white", "shown", "note"),
    [
        ([4095, 900], None, [16, 4], "no value above 4095 and are nearly black"),
        ([4095, 900], 4095, [255, 56], ""),
        ([900, 100], 4095, [56, 6], ""),
        ([51400, 4095], None, [200, 16], ""),
    ],
)
def test_open_clips__names_dark_images_of_16_bits_without_a_white(
    tmp_path, caplog, kind, most, white, shown, note
):
    clips = {camera: tmp_path / f"{camera}.mkv" for camera in range(len(most))}
    for clip, value in zip(clips.values(), most, strict=True):
        write_camera(clip, kind, [value])
    readers = open_clips(clips, white=white)
    assert [next(reader.frames())[0, 0, 0] for reader in readers.values()] == shown
    assert note in caplog.text
    assert bool(note) == bool(caplog.text)


@pytest.mark.parametrize("kind", ["images", "video"])
def test_open_clips__refuses_values_above_white(tmp_path, kind):
    write_camera(tmp_path / "a.mkv", kind, [4095, 5000])
    reader = open_clips({"a": tmp_path / "a.mkv"}, white=4095)["a"]
    with pytest.raises(ValueError, match=r"expected values up to the `white` .* 4095, got 5000"):
        list(reader.frames())


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_open_clips__refuses_images_that_have_neither_8_nor_16_bits(tmp_path, dtype):
    cv2.imwrite(str(tmp_path / "0.tif"), np.full((32, 48, 3), 9, dtype))
    with pytest.raises(ValueError, match=r"0\.tif: expected 8 or 16 bits"):
        open_clips({"a": tmp_path})
