"""A clip gives any frame, in any order, of a file that grows; trails say where Gaussians came from."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.playback.player import channel_image, open_stream, render
from morgs_mi.playback.visualise import confidence_image, motion_image
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize
from morgs_mi.viewer.clip import Clip
from morgs_mi.viewer.modes import FULL_SPEED, MODES, splat_colors
from tests.export.streams import rig, splats, write_stream


@pytest.fixture
def states(tmp_path) -> list[CodedFrame]:
    return write_stream(tmp_path / "stream.morgs", 6)


def test_frames_come_in_any_order(tmp_path, states):
    clip = Clip(tmp_path)
    for frame in (0, 1, 2, 5, 1, 1, 4, 3, 0):
        found = clip.at(frame)
        assert found.frame == frame
        np.testing.assert_array_equal(found.digest, states[frame].digest)
        np.testing.assert_array_equal(found.gaussians.numpy()["motion"], states[frame].gaussians.numpy()["motion"])
    with pytest.raises(ValueError, match="expected a frame of the stream, got 6"):
        clip.at(6)
    assert clip.at(2).frame == 2


def test_a_file_that_grows_is_followed_and_one_begun_anew_is_read_anew(tmp_path, states):
    whole = (tmp_path / "stream.morgs").read_bytes()
    ends = [offset for _, _, offset in open_stream(tmp_path).index()]
    growing = tmp_path / "growing.morgs"
    growing.write_bytes(whole[: ends[3]])
    clip = Clip(growing)
    assert clip.frames == [0, 1, 2]
    assert clip.at(2).frame == 2
    assert not clip.refresh()
    growing.write_bytes(whole[: ends[4] + 10])  # the next and a piece of the one after it
    assert clip.refresh()
    assert clip.frames == [0, 1, 2, 3]
    np.testing.assert_array_equal(clip.at(3).digest, states[3].digest)
    growing.write_bytes(whole)
    assert clip.refresh()
    np.testing.assert_array_equal(clip.at(5).digest, states[5].digest)
    others = write_stream(growing, 2, splats(30, seed=3))
    assert clip.refresh()
    assert clip.frames == [0, 1]
    np.testing.assert_array_equal(clip.at(1).digest, others[1].digest)
    growing.write_bytes(b"")
    with pytest.raises(ValueError, match="the header is missing"):
        clip.refresh()
    growing.write_bytes(whole)
    assert clip.refresh()
    np.testing.assert_array_equal(clip.at(5).digest, states[5].digest)


def test_trails_are_the_steps_of_what_moved(tmp_path, states):
    clip = Clip(tmp_path)
    lines, ages = clip.trails(3, length=2)
    assert clip.at(3).frame == 3
    means = [state.gaussians.numpy()["means"] for state in states]
    moved = np.isin(states[3].ids, states[2].ids) & (states[3].gaussians.numpy()["motion"] != 0).any(1)
    newest = lines[ages == 0]
    assert len(newest) == moved.sum()
    np.testing.assert_array_equal(np.sort(newest[:, 1], 0), np.sort(means[3][moved], 0))
    assert sorted(set(ages)) == [0, 0.5]
    # A step of 0.1, quantised to a tenth of a pixel or 0.007.
    np.testing.assert_allclose(lines[:, 1] - lines[:, 0], np.broadcast_to([0.1, 0, 0], (len(lines), 3)), atol=0.01)
    assert len(clip.trails(3, length=2, count=5)[0]) <= 10
    assert clip.trails(0, length=2)[0].shape == (0, 2, 3)


def test_one_splat_has_the_colour_that_the_renderer_gives_it(states):
    camera = rig(65, 49)[1]
    for k in range(5):
        one = states[1].gaussians.select([k])
        here = one.numpy()["means"][0]
        facing = Camera.look_at(camera.position, here, (0, 0, 1), 45, 65, 49)
        drawn = rasterize(one, facing, ("color", "alpha", "motion", "confidence"))
        alpha = np.array(drawn.alpha)[24, 32]
        color = np.clip(np.array(drawn.color)[24, 32] / alpha, 0, 1)
        np.testing.assert_allclose(splat_colors(one, facing, "color")[0] / 255, color, atol=0.01)
        motion = motion_image(np.array(drawn.motion)[24:25, 32:33], FULL_SPEED["motion"] * 65)[0, 0].astype(int)
        np.testing.assert_allclose(splat_colors(one, facing, "motion")[0], motion, atol=2)
        learned = channel_image("offset", render(one, facing, ("offset",), RenderConfig())["offset"])[24, 32]
        np.testing.assert_allclose(splat_colors(one, facing, "offset")[0].astype(int), learned, atol=2)
        assert learned.astype(int).min() < 200, "the first half of the splats moves"
        confidence = confidence_image(np.array(drawn.confidence)[24:25, 32:33] / alpha)[0, 0].astype(int)
        np.testing.assert_allclose(splat_colors(one, facing, "confidence")[0], confidence, atol=3)


def test_every_mode_colours_every_splat(states):
    for mode in MODES:
        found = splat_colors(states[1].gaussians, rig()[0], mode)
        assert (found.dtype, found.shape) == (np.uint8, (40, 3))
    assert (splat_colors(states[0].gaussians, rig()[0], "offset") == 255).all(), "nothing is known of it"
    with pytest.raises(ValueError, match="the mode must be one of color, motion, confidence, offset, depth"):
        splat_colors(states[1].gaussians, rig()[0], "quats")


def test_without_viser_there_is_a_sentence(tmp_path, states, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["view", str(tmp_path)]) == 1
    assert "install it with pip install 'morgs-mi[viewer]'" in capsys.readouterr().err
