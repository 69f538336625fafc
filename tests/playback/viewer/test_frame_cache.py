"""Frames of a growing file in any order, and trails of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.playback.player import PROVISIONAL
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.viewer.frame_cache import FrameCache
from tests.assertions import assert_close
from tests.codec.forge import forged_streams
from tests.scenes.changing_splats import splats, write_stream
from tests.scenes.short_clip import FRAMES, short_clip


@pytest.fixture
def states(tmp_path) -> list[CodedFrame]:
    return write_stream(tmp_path / "stream.morgs", 6)


def test_frame_cache__returns_frames_in_any_order(tmp_path, states):
    cache = FrameCache(tmp_path)
    for index in (0, 1, 2, 5, 1, 1, 4, 3, 0):
        frame = cache.at(index)
        assert frame.frame == index
        np.testing.assert_array_equal(frame.digest, states[index].digest)
        np.testing.assert_array_equal(frame.gaussians.numpy()["motion"], states[index].gaussians.numpy()["motion"])
    with pytest.raises(ValueError, match="expected a frame of the stream, got 6"):
        cache.at(6)
    assert cache.at(2).frame == 2


def test_frame_cache__follows_a_growing_file_and_reopens_a_replaced_one(tmp_path, states):
    complete = (tmp_path / "stream.morgs").read_bytes()
    ends = [offset for _, _, offset in open_stream(tmp_path).index()]
    growing = tmp_path / "growing.morgs"
    growing.write_bytes(complete[: ends[3]])
    cache = FrameCache(growing)
    assert cache.frames == [0, 1, 2]
    assert cache.at(2).frame == 2
    assert not cache.refresh()
    growing.write_bytes(complete[: ends[4] + 10])  # the next packet and the beginning of the one after it
    assert cache.refresh()
    assert cache.frames == [0, 1, 2, 3]
    np.testing.assert_array_equal(cache.at(3).digest, states[3].digest)
    growing.write_bytes(complete)
    assert cache.refresh()
    np.testing.assert_array_equal(cache.at(5).digest, states[5].digest)
    others = write_stream(growing, 2, splats(30, seed=3))
    assert cache.refresh()
    assert cache.frames == [0, 1]
    np.testing.assert_array_equal(cache.at(1).digest, others[1].digest)
    growing.write_bytes(b"")
    with pytest.raises(ValueError, match="the header is missing"):
        cache.refresh()
    growing.write_bytes(complete)
    assert cache.refresh()
    np.testing.assert_array_equal(cache.at(5).digest, states[5].digest)


def test_frame_cache__shows_a_provisional_first_frame_until_the_stream_has_one(tmp_path, states):
    stream, provisional = tmp_path / "stream.morgs", tmp_path / PROVISIONAL
    complete, (_, _, start), (_, _, end) = stream.read_bytes(), *open_stream(stream).index()[:2]
    write_stream(provisional, 1, splats(30, seed=3))
    cache = FrameCache(tmp_path)
    assert not cache.is_provisional
    stream.write_bytes(complete[:start])
    assert cache.refresh()
    assert cache.is_provisional
    assert (cache.frames, len(cache.at(0).gaussians)) == ([0], 30)
    assert not cache.refresh()
    write_stream(tmp_path / "next.morgs", 1, splats(40, seed=3))
    (tmp_path / "next.morgs").replace(provisional)
    assert cache.refresh()
    assert len(cache.at(0).gaussians) == 40
    stream.write_bytes(complete[:end])
    provisional.unlink()
    cache.refresh()
    assert not cache.is_provisional
    np.testing.assert_array_equal(cache.at(0).digest, states[0].digest)


def test_trails__are_the_displacements_of_the_moving_gaussians(tmp_path, states):
    cache = FrameCache(tmp_path)
    lines, ages = cache.trails(3, length=2)
    assert cache.at(3).frame == 3
    means = [state.gaussians.numpy()["means"] for state in states]
    moved = np.isin(states[3].ids, states[2].ids) & (states[3].gaussians.numpy()["motion"] != 0).any(1)
    newest = lines[ages == 0]
    assert len(newest) == moved.sum()
    np.testing.assert_array_equal(np.sort(newest[:, 1], 0), np.sort(means[3][moved], 0))
    assert sorted(set(ages)) == [0, 0.5]
    # A step of 0.1, quantised to a tenth of a pixel or 0.007.
    assert_close(lines[:, 1] - lines[:, 0], np.broadcast_to([0.1, 0, 0], (len(lines), 3)), atol=0.01)
    assert len(cache.trails(3, length=2, count=5)[0]) <= 10
    assert cache.trails(0, length=2)[0].shape == (0, 2, 3)


def test_first_moving__skips_frames_without_motion(tmp_path, states):
    cache = FrameCache(tmp_path)
    assert [cache.first_moving(frame) for frame in cache.frames] == [1, *cache.frames[1:]]
    still = tmp_path / "still.morgs"
    write_stream(still, 1)
    assert FrameCache(still).first_moving(0) == 0


@pytest.mark.parametrize("order", [range(FRAMES), range(FRAMES)[::-1], (7, 4, 1, 5, 3, 6, 2, 0)])
def test_frame_cache__returns_every_frame_that_plays(tmp_path, order):
    for data in forged_streams(short_clip()):
        (tmp_path / "stream.morgs").write_bytes(data)
        states = {state.frame: state for state in coded_frames(StreamReader(tmp_path / "stream.morgs"))}
        assert len(states) == FRAMES
        cache = FrameCache(tmp_path)
        for frame in order:
            np.testing.assert_array_equal(cache.at(frame).digest, states[frame].digest)
            assert len(cache.trails(cache.frames[-1], 3)) == 2
