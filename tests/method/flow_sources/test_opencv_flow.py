"""Optical flow and the flow observation: sign, grid, reliability."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FlowConfig, FramePair
from morgs_mi.method.flow_sources.opencv_flow import FLOW_METHODS, optical_flow
from tests.method.moving_disc import moving_disc, texture


@pytest.mark.parametrize("method", FLOW_METHODS)
def test_optical_flow__recovers_a_translation_with_its_sign(method):
    scene = texture(140, 180, seed=1)
    for dx, dy in ((5, 3), (-4, 0), (0, -2)):
        previous = scene[10:130, 10:170]
        image = scene[10 - dy : 130 - dy, 10 - dx : 170 - dx]
        motion = -optical_flow(image, previous, method)
        error = np.linalg.norm(motion - (dx, dy), axis=-1)[10:-10, 10:-10]
        # `dis-ultrafast` stops at a quarter of the resolution.
        assert np.median(error) < 0.5, (dx, dy)


@pytest.mark.parametrize("method", FLOW_METHODS)
@pytest.mark.parametrize("size", [(15, 40), (90, 16)])
def test_optical_flow__is_finite_at_any_size(method, size):
    rng = np.random.default_rng(0)
    image, previous = rng.integers(0, 255, (2, *size, 3), dtype=np.uint8)
    flow = optical_flow(image, previous, method)
    assert flow.shape == (*size, 2)
    assert flow.dtype == np.float32
    assert np.isfinite(flow).all()
    assert min(size) >= 16 or not flow.any()


@pytest.mark.parametrize("method", FLOW_METHODS)
def test_optical_flow__is_finite_with_nothing_to_match(method):
    image = (255 * texture(60, 80, seed=3)).astype(np.uint8)
    flat = np.full((60, 80, 3), 90, np.uint8)
    for previous, following in ((flat, flat), (flat, image), (image, flat)):
        assert np.isfinite(optical_flow(following, previous, method)).all()
    # Every method finds no motion between equal images; RLOF interpolates between sparse matches.
    assert np.abs(optical_flow(image, image, method)).max() < 0.1


def test_flow_config__fine_width_selects_the_finest_level_of_dis():
    previous, image, _ = moving_disc(64, 96, shift=(6, 1))
    fine, half = (
        optical_flow(image, previous, "dis", FlowConfig(fine_width=width)) for width in (96, 95)
    )
    assert_array_equal(fine, optical_flow(image, previous, "dis-fine"))
    gray = (
        cv2.cvtColor((255 * a + 0.5).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        for a in (image, previous)
    )
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # at half resolution
    assert_array_equal(half, method.calc(*gray, None))
    source_flow, _ = FLOW_SOURCES.make("dis", FlowConfig(fine_width=95))(FramePair(image, previous))
    assert_array_equal(source_flow, half)


def test_both_directions__computes_flow_inside_the_box_alone():
    previous, image, _ = moving_disc(64, 96, shift=(6, 1))
    box = slice(10, 60), slice(20, 90)
    flow, forward_flow = FLOW_SOURCES.make("dis")(FramePair(image, previous, box=box))
    assert_array_equal(flow[box], optical_flow(image[box], previous[box]))
    assert_array_equal(forward_flow[box], optical_flow(previous[box], image[box]))
    for each in (flow, forward_flow):
        outside = each.copy()
        outside[box] = 0
        assert not outside.any()
