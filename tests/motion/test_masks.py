"""Motion masks: nothing where nothing moves, the object where one does."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.motion.cues import motion_cue
from morgs_mi.motion.masks import flow_mask, flow_threshold, refine_mask
from tests.motion.moving_disc import moving_disc

CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("size", [(120, 160), (240, 320)])
def test_static_pair_gives_an_empty_mask_under_camera_noise(size):
    previous, image, _ = moving_disc(*size, shift=(0, 0), noise=CAMERA_NOISE)
    assert not motion_cue(image, previous, with_mask=True).mask.any()


@pytest.mark.parametrize("shift", [(6, -4), (1, 0)])
def test_moving_disc_is_found(shift):
    previous, image, disc = moving_disc(240, 320, shift, CAMERA_NOISE)
    mask = motion_cue(image, previous, with_mask=True).mask
    # DIS spreads motion by up to half a patch, 4 px: the bound is a disc of 48 px radius grown by that much.
    assert overlap(mask, disc) > (48 / 52) ** 2 - 0.1
    assert mask[disc].mean() > 0.95


def test_refinement_recovers_an_object_from_a_part_of_it():
    _, image, disc = moving_disc(240, 320, (3, 0), CAMERA_NOISE)
    part = disc.copy()
    part[120:140] = False
    assert overlap(refine_mask(image, part), disc) > 0.95 > overlap(part, disc)


def test_union_never_loses_flow():
    previous, image, _ = moving_disc(120, 160, (3, 2))
    cue = motion_cue(image, previous, with_mask=True)
    assert not (flow_mask(cue.motion, cue.reliable) & ~cue.mask).any()


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (40, 30), (700, 20)])
@pytest.mark.parametrize("fill", ["nothing", "speck", "all", "half"])
def test_refinement_takes_any_mask(size, fill):
    image = np.random.default_rng(0).random((*size, 3))
    mask = np.full(size, fill == "all")
    if fill == "half":
        mask[: size[0] // 2] = True
    mask[size[0] // 2, size[1] // 2] |= fill == "speck"
    refined = refine_mask(image, mask)
    assert refined.shape == size
    assert refined.dtype == bool
    if fill == "nothing":
        assert not refined.any()
    if fill == "all":
        assert refined.all()


def test_refinement_is_repeatable():
    _, image, disc = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    np.testing.assert_array_equal(refine_mask(image, disc), refine_mask(image, disc))


def test_threshold_follows_width_and_noise():
    assert flow_threshold(np.zeros((4, 1352, 2))) == 0.5
    assert flow_threshold(np.zeros((4, 2704, 2))) == 1.0
    assert flow_threshold(np.zeros((4, 160, 2))) == 0.2
    noisy = np.random.default_rng(0).normal(0, 1, (100, 100, 2))
    # Rayleigh: median 1.18, MAD 0.45; 1 % of it lies above 3.
    assert flow_threshold(noisy) == pytest.approx(1.18 + 4 * 0.45, rel=0.05)


def test_unreliable_pixels_are_static():
    motion = np.zeros((8, 8, 2))
    motion[:2] = 9
    reliable = np.ones((8, 8), bool)
    reliable[0] = False
    assert flow_mask(motion, reliable).sum() == 8


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: flow_mask(np.zeros((4, 4))), r"\[H, W, 2\], got \(4, 4\)"),
        (lambda: flow_mask(np.zeros((4, 4, 2)), np.ones((3, 4), bool)), r"got \(3, 4\)"),
        (lambda: refine_mask(np.zeros((4, 4, 3)), np.ones((3, 4), bool)), r"got \(4, 4, 3\)"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
