"""Observations of a frame that follow from its images."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.loop.observation import ImageHistory, observe_frame, prepare
from morgs_mi.method.confidence import flow_mask
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig
from morgs_mi.method.objective import ObjectiveConfig
from tests.scenes.recording import CONFIG, recording


def key_views(weight, method):
    """Return the key views of the second frame with a weight of the masks and their refinement."""
    capture = recording()
    fit = replace(CONFIG.fit, objective=ObjectiveConfig(mask_weight=weight))
    motion = replace(CONFIG.motion, mask_interval=1, mask_method=method)
    config = replace(CONFIG, fit=fit, motion=motion)
    setup = prepare(capture.cameras, capture.points, capture.point_colors, config)
    history = ImageHistory()
    for frame in capture.partial_frames(0, 2):
        observation = observe_frame(setup, frame.index, history, frame.images)
        history = observation.history
    return list(observation.key_views.values())


@pytest.mark.parametrize("method", ["none", "grabcut"])
def test_observe_frame__has_masks_by_the_chosen_method(method):
    (view,) = key_views(0.5, method)
    mask = flow_mask(view.flow.motion, view.flow.reliable, MaskConfig())
    assert_array_equal(view.flow.mask, MASK_REFINERS.make(method)(view.pair.image, mask))
    assert np.array_equal(view.flow.mask, mask) == (method == "none")


def test_observe_frame__has_no_masks_where_their_loss_has_no_weight():
    (view,) = key_views(0.0, "none")
    assert view.flow.mask is None
