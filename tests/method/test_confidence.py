"""Motion masks: empty for a static scene, and the object where one moves."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.method.confidence import flow_mask, flow_threshold, motion_floor, motion_mask
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from tests.method.moving_disc import moving_disc, observed

CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


METHODS = [usage for usage in MASK_REFINERS.usages if ":" not in usage]


@pytest.mark.parametrize("size", [(120, 160), (240, 320)])
@pytest.mark.parametrize("method", METHODS)
def test_motion_mask__is_empty_for_a_static_pair_under_camera_noise(method, size):
    previous, image, _ = moving_disc(*size, shift=(0, 0), noise=CAMERA_NOISE)
    assert not observed(image, previous, method).mask.any()


@pytest.mark.parametrize("shift", [(6, -4), (1, 0)])
@pytest.mark.parametrize("method", METHODS)
def test_motion_mask__finds_a_moving_disc(method, shift):
    previous, image, disc = moving_disc(240, 320, shift, CAMERA_NOISE)
    mask = observed(image, previous, method).mask
    # DIS spreads motion by up to half a patch, 4 px: the bound is a disc of 48 px radius grown by
    # that much.
    assert overlap(mask, disc) > (48 / 52) ** 2 - 0.1
    assert mask[disc].mean() > 0.95


def test_motion_mask__with_grabcut_contains_the_flow_mask():
    previous, image, _ = moving_disc(120, 160, (3, 2))
    observation = observed(image, previous, "grabcut")
    assert not (flow_mask(observation.motion, observation.reliable) & ~observation.mask).any()


def test_motion_mask__passes_its_config_to_threshold_and_refiner():
    previous, image, _ = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    motion = observed(image, previous).motion
    for config in (MaskConfig(floor=20), MaskConfig(superpixel_share=0.2)):
        expected = MASK_REFINERS.make("superpixels+grabcut", config)(
            image, flow_mask(motion, config=config)
        )
        np.testing.assert_array_equal(
            motion_mask(image, motion, method="superpixels+grabcut", config=config), expected
        )
        assert not np.array_equal(
            expected, motion_mask(image, motion, method="superpixels+grabcut")
        )


def test_observe_key_views__masks_are_those_of_the_configured_method():
    previous, image, _ = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    pair = {7: FramePair(image, previous)}
    for method in METHODS:
        observation = observe_key_views(pair, "dis", method)[7]
        mask = flow_mask(observation.motion, observation.reliable)
        np.testing.assert_array_equal(observation.mask, MASK_REFINERS.make(method)(image, mask))
    assert observe_key_views(pair)[7].mask is None


def test_flow_threshold__follows_width_and_noise():
    assert flow_threshold(np.zeros((4, 1352, 2))) == 0.5
    assert flow_threshold(np.zeros((4, 2704, 2))) == 1.0
    assert flow_threshold(np.zeros((4, 160, 2))) == 0.2
    noisy = np.random.default_rng(0).normal(0, 1, (100, 100, 2))
    # Rayleigh: median 1.18, MAD 0.45; 1 % of it lies above 3.
    assert flow_threshold(noisy) == pytest.approx(1.18 + 4 * 0.45, rel=0.05)
    assert flow_threshold(noisy, config=MaskConfig(threshold_mads=2)) == pytest.approx(
        1.18 + 2 * 0.45, rel=0.05
    )


@pytest.mark.parametrize(
    ("width", "config", "floor"),
    [
        (1352, MaskConfig(), 0.5),
        (1352, MaskConfig(floor=0.8), 0.8),
        (676, MaskConfig(floor=0.8), 0.4),
        (160, MaskConfig(), 0.2),
    ],
)
def test_motion_floor__is_that_of_the_config(width, config, floor):
    assert motion_floor(width, config) == pytest.approx(floor, rel=1e-12)


def test_flow_mask__excludes_unreliable_pixels():
    motion = np.zeros((8, 8, 2))
    motion[:2] = 9
    reliable = np.ones((8, 8), bool)
    reliable[0] = False
    assert flow_mask(motion, reliable).sum() == 8
