"""Observations of a frame that follow from its images."""

from dataclasses import replace

import pytest

from morgs_mi.loop.observation import ImageHistory, observe_frame, prepare
from morgs_mi.method.objective import ObjectiveConfig
from tests.scenes.recording import CONFIG, recording


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_observe_frame__has_masks_where_their_loss_has_a_weight(weight):
    capture = recording()
    fit = replace(CONFIG.fit, objective=ObjectiveConfig(mask_weight=weight))
    config = replace(CONFIG, fit=fit, motion=replace(CONFIG.motion, mask_interval=1))
    setup = prepare(capture.cameras, capture.points, capture.point_colors, config)
    history = ImageHistory()
    for frame in capture.partial_frames(0, 2):
        observation = observe_frame(setup, frame.index, history, frame.images)
        history = observation.history
    assert observation.key_views
    for view in observation.key_views.values():
        assert (view.flow.mask is None) == (weight == 0)
