"""Properties of the EXR files."""

import numpy as np
import OpenEXR
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.io.exr import opaque_light, read_exr, read_light, write_exr


def test_read_exr__inverts_write_exr_exactly_in_float32(tmp_path):
    channels = {
        "motion.X": np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32),
        "id.Y": np.arange(35).reshape(5, 7),
        "mask.Y": np.eye(5, 7) > 0,
    }
    write_exr(tmp_path / "a.exr", channels)
    back = read_exr(tmp_path / "a.exr")
    assert back.keys() == channels.keys()
    for name, channel in channels.items():
        assert back[name].dtype == np.float32
        assert_array_equal(back[name], channel)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_read_exr__distinguishes_missing_and_damaged_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected an EXR file, found none"):
        read_exr(tmp_path / "a.exr")
    write_exr(tmp_path / "a.exr", {"a": np.random.default_rng(0).normal(size=(64, 64))})
    whole = (tmp_path / "a.exr").read_bytes()
    for damaged in (b"no image", whole[: len(whole) // 2]):
        (tmp_path / "a.exr").write_bytes(damaged)
        with pytest.raises(OSError, match="cannot read"):
            read_exr(tmp_path / "a.exr")
    with pytest.raises(OSError, match=r"cannot write .*gone/a\.exr"):
        write_exr(tmp_path / "gone" / "a.exr", {"a": np.zeros((2, 3))})
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def channels_of(light):
    return {name: np.ascontiguousarray(light[..., k]) for k, name in enumerate("RGB")}


LIGHT = np.random.default_rng(0).uniform(0, 20, (4, 5, 3)).astype(np.float32)


def test_read_light__converts_other_primaries(tmp_path):
    """By the matrices of ITU-R BT.2087 from Rec. 2020, in which Rec. 709's colours fit."""
    to_2020 = np.array(
        [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    )
    primaries = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
    header = {"type": OpenEXR.scanlineimage, "chromaticities": primaries}
    OpenEXR.File(header, channels_of((LIGHT @ to_2020.T).astype(np.float32))).write(
        str(tmp_path / "a.exr")
    )
    assert_allclose(read_light(tmp_path / "a.exr"), LIGHT, atol=0.01)


def write(path, channels, **header):
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels).write(str(path))
    return path


def window(left, top, right, bottom):
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def test_read_light__returns_the_display_window_and_opaque_light_its_stored_pixels(tmp_path):
    """A window that is moved, smaller, larger, and elsewhere."""
    for data in ((1, 2, 5, 5), (1, 1, 2, 2), (-3, -1, 9, 7), (20, 20, 24, 23)):
        y, x = np.mgrid[data[1] : data[3] + 1, data[0] : data[2] + 1]
        place = channels_of(np.stack([x, y, x + y], axis=-1).astype(np.float32) + 20)
        windows = {"dataWindow": window(*data), "displayWindow": window(0, 0, 4, 3)}
        path = write(tmp_path / "a.exr", place, **windows)
        y, x = np.mgrid[:4, :5]
        stored = (x >= data[0]) & (x <= data[2]) & (y >= data[1]) & (y <= data[3])
        expected = stored[..., None] * (np.stack([x, y, x + y], axis=-1) + 20)
        assert_array_equal(read_light(path), expected)
        assert_array_equal(opaque_light(path), stored)


def test_read_light__reads_grey_or_colours_with_their_alpha(tmp_path):
    write_exr(tmp_path / "grey.exr", {"Y": LIGHT[..., 0]})
    assert_array_equal(read_light(tmp_path / "grey.exr"), LIGHT[..., [0, 0, 0]])
    alpha = np.linspace(0, 1.1, 20, dtype=np.float32).reshape(4, 5)
    channels = {**channels_of(LIGHT), "A": alpha, "depth.Y": LIGHT[..., 1]}
    path = write(tmp_path / "a.exr", channels)
    assert_array_equal(read_light(path), LIGHT)
    assert_array_equal(opaque_light(path), alpha >= 1)


@pytest.mark.parametrize(
    ("channels", "header", "message"),
    [
        (
            {f"ViewLayer.Combined.{name}": LIGHT[..., 0] for name in "RGB"},
            {},
            r"channels R, G, B, or Y, got ViewLayer\.Combined\.B, .*; save .* without layers",
        ),
        ({"depth.Y": LIGHT[..., 0]}, {}, r"channels R, G, B, or Y, got depth\.Y; save"),
        (channels_of(LIGHT), {"pixelAspectRatio": 2.0}, "square pixels, got the pixel aspect 2"),
        (channels_of(LIGHT + np.inf), {}, r"a\.exr: its image must be finite .* replace such"),
    ],
    ids=["layers", "depth", "aspect", "infinite"],
)
def test_read_light__refuses_other_channels_and_pixels(tmp_path, channels, header, message):
    with pytest.raises(ValueError, match=message):
        read_light(write(tmp_path / "a.exr", channels, **header))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"dataWindow", b"dataWindox", "dataWindow"),
        (b"B\0\2\0\0\0\0\0\0\0\1", b"B\0\2\0\0\0\0\0\0\0\2", "channel B has fewer numbers"),
    ],
    ids=["no window", "subsampled"],
)
def test_read_exr__names_the_defect_of_a_header(tmp_path, old, new, message):
    path = write(tmp_path / "a.exr", channels_of(LIGHT))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(OSError, match=rf"cannot read {path}: .*{message}.*; the file may be"):
        read_exr(path)
