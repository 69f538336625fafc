"""Properties of the EXR files."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.io.exr import read_exr, write_exr


def test_read_exr__inverts_write_exr_exactly(tmp_path):
    rng = np.random.default_rng(0)
    channels = {name: rng.normal(size=(5, 7)).astype(np.float32) for name in ("motion.X", "motion.Y", "depth.Y")}
    write_exr(tmp_path / "a.exr", channels)
    back = read_exr(tmp_path / "a.exr")
    assert back.keys() == channels.keys()
    for name, channel in channels.items():
        np.testing.assert_array_equal(back[name], channel)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_write_exr__converts_other_types_to_float32(tmp_path):
    write_exr(tmp_path / "a.exr", {"id.Y": np.arange(6).reshape(2, 3), "mask.Y": np.eye(2, 3) > 0})
    back = read_exr(tmp_path / "a.exr")
    assert {channel.dtype for channel in back.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(back["id.Y"], np.arange(6).reshape(2, 3))


@pytest.mark.parametrize(
    "channels",
    [{}, {"a": np.zeros(3)}, {"a": np.zeros((2, 3)), "b": np.zeros((3, 2))}],
    ids=["none", "1d", "mixed"],
)
def test_write_exr__refuses_channels_of_other_shapes(tmp_path, channels):
    with pytest.raises(ValueError, match=r"must share one shape \[H, W\]"):
        write_exr(tmp_path / "a.exr", channels)


def test_write_exr__raises_and_leaves_nothing_on_failure(tmp_path):
    with pytest.raises(OSError, match=r"cannot write .*gone/a\.exr"):
        write_exr(tmp_path / "gone" / "a.exr", {"a": np.zeros((2, 3))})
    (tmp_path / "a.exr").mkdir()
    with pytest.raises(OSError, match="cannot write"):
        write_exr(tmp_path / "a.exr", {"a": np.zeros((2, 3))})
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_read_exr__distinguishes_missing_and_damaged_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        read_exr(tmp_path / "a.exr")
    write_exr(tmp_path / "a.exr", {"a": np.random.default_rng(0).normal(size=(64, 64))})
    whole = (tmp_path / "a.exr").read_bytes()
    for damaged in (b"", b"no image", whole[: len(whole) // 2]):
        (tmp_path / "a.exr").write_bytes(damaged)
        with pytest.raises(OSError, match="cannot read"):
            read_exr(tmp_path / "a.exr")
