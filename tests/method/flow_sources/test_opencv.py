"""Optical flow and the motion cue: sign, grid, reliability."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.method.flow import observe_flow
from morgs_mi.method.flow_sources.opencv import FLOW_METHODS, optical_flow
from tests.method.moving_disc import moving_disc, texture


@pytest.mark.parametrize("method", FLOW_METHODS)
@pytest.mark.parametrize("shift", [(5, 3), (-4, 0), (0, -2)])
def test_translation_is_recovered_with_its_sign(method, shift):
    dx, dy = shift
    scene = texture(140, 180, seed=1)
    previous, image = scene[10:130, 10:170], scene[10 - dy : 130 - dy, 10 - dx : 170 - dx]
    motion = -optical_flow(image, previous, method)
    error = np.linalg.norm(motion - shift, axis=-1)[10:-10, 10:-10]
    # Ultrafast and fast stop at a quarter of the resolution.
    assert np.median(error) < 0.5


def test_motion_is_the_shift_on_frame_ts_grid():
    previous, image, disc = moving_disc(240, 320, shift=(6, -4))
    cue = observe_flow(image, previous)
    motion, reliable = cue.motion, cue.reliable
    # 0.25 px: DIS smooths over 8x8 patches.
    assert np.abs(motion[disc & reliable] - (6, -4)).mean() < 0.25
    assert np.linalg.norm(motion[~disc & reliable], axis=-1).mean() < 0.25
    assert reliable[disc].mean() > 0.8


def test_what_was_hidden_is_not_reliable():
    previous, image, disc = moving_disc(240, 320, shift=(10, 0))
    reliable = observe_flow(image, previous).reliable
    uncovered = np.roll(disc, (0, -10), (0, 1)) & ~disc
    assert reliable[uncovered].mean() < 0.5 < 0.95 < reliable.mean()


def test_float_and_bytes_agree():
    previous, image, _ = moving_disc(64, 96, shift=(2, 1))
    as_bytes = [(frame * 255 + 0.5).astype(np.uint8) for frame in (image, previous)]
    np.testing.assert_array_equal(optical_flow(image, previous), optical_flow(*as_bytes))


@pytest.mark.parametrize("method", FLOW_METHODS)
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (15, 15), (16, 16), (16, 90), (90, 16), (24, 24), (31, 70)])
def test_any_size_gives_a_finite_flow(method, size):
    rng = np.random.default_rng(0)
    image, previous = rng.integers(0, 255, (2, *size, 3), dtype=np.uint8)
    flow = optical_flow(image, previous, method)
    assert flow.shape == (*size, 2)
    assert flow.dtype == np.float32
    assert np.isfinite(flow).all()
    assert min(size) >= 16 or not flow.any()


@pytest.mark.parametrize("method", FLOW_METHODS)
def test_pictures_with_nothing_to_match_give_a_finite_flow(method):
    scene = (255 * texture(130, 150, seed=3)).astype(np.uint8)
    image, flat = scene[:60, :80], np.full((60, 80, 3), 90, np.uint8)
    part = np.where(np.arange(80)[:, None] < 20, image, flat)
    for previous, following in ((flat, flat), (flat, image), (image, flat), (part, part), (image, scene[70:, 70:])):
        flow = optical_flow(following, previous, method)
        assert np.isfinite(flow).all()
    # A picture that stands still does so in every method; RLOF and PCAFlow interpolate between sparse matches.
    assert np.abs(optical_flow(image, image, method)).max() < 0.1


RGB = np.zeros((20, 20, 3), np.uint8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((RGB, RGB, "raft"), "dis-medium.*got 'raft'"),
        ((RGB, RGB[:18]), "one size"),
        ((RGB[..., 0], RGB[..., 0]), r"RGB .* \(20, 20\)"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        optical_flow(*arguments)
