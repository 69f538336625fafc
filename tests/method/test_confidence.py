"""Motion masks: empty for a static scene, and the object where one moves."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.evaluate.metrics import iou
from morgs_mi.method.confidence import flow_mask, motion_floor
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from tests.method.moving_disc import moving_disc, observed

CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


CONFIG = MaskConfig()
METHODS = [usage for usage in MASK_REFINERS.usages if ":" not in usage]


@pytest.mark.parametrize("method", METHODS)
def test_motion_mask__is_empty_for_a_static_pair_under_camera_noise(method):
    previous, image, _ = moving_disc(240, 320, shift=(0, 0), noise=CAMERA_NOISE)
    assert not observed(image, previous, method).mask.any()


@pytest.mark.parametrize("shift", [(6, -4), (1, 0)])
@pytest.mark.parametrize("method", METHODS)
def test_motion_mask__finds_a_moving_disc(method, shift):
    previous, image, disc = moving_disc(240, 320, shift, CAMERA_NOISE)
    mask = observed(image, previous, method).mask
    # DIS spreads motion by up to half a patch, 4 px: the bound is a disc of 48 px radius grown by
    # that much.
    assert iou(mask, disc) > (48 / 52) ** 2 - 0.1
    assert mask[disc].mean() > 0.95


def test_observe_key_views__masks_follow_their_settings():
    previous, image, _ = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    for config in (CONFIG, MaskConfig(floor=50)):
        pair = FramePair(image, previous)
        observation = observe_key_views({7: pair}, "dis", "grabcut", masks=config)[7]
        flow = flow_mask(observation.motion, observation.reliable, config)
        assert_array_equal(observation.mask, MASK_REFINERS.make("grabcut", config)(image, flow))
        assert flow.any() == (config is CONFIG)
    assert observed(image, previous).mask is None


def test_motion_floor__follows_the_width():
    for width, threshold in ((1352, 0.5), (2704, 1.0), (160, 0.2)):
        assert motion_floor(width, CONFIG) == threshold
    assert motion_floor(676, MaskConfig(floor=0.8)) == pytest.approx(0.4, rel=1e-12)


def test_flow_mask__has_the_reliable_pixels_above_the_floor():
    motion = np.zeros((1, 1352, 2))
    motion[0, :3, 0] = 0.49, 0.51, -0.51
    reliable = np.ones((1, 1352), bool)
    assert np.flatnonzero(flow_mask(motion, reliable, CONFIG)).tolist() == [1, 2]
    reliable[0, 1] = False
    assert np.flatnonzero(flow_mask(motion, reliable, CONFIG)).tolist() == [2]


def test_flow_mask__excludes_unreliable_pixels():
    motion = np.zeros((8, 8, 2))
    motion[:2] = 9
    reliable = np.ones((8, 8), bool)
    reliable[0] = False
    assert flow_mask(motion, reliable, CONFIG).sum() == 8
