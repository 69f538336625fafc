"""Backgrounds of fits without points, by their images."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from morgs_mi.fit.initialise import mean_color
from morgs_mi.loop.observation import over_border, prepare
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.render.render_config import RenderConfig
from tests.scenes.room import rig, room_view


def test_over_border__of_few_far_cameras_is_the_mean_colour(caplog):
    views = [room_view(camera) for camera in rig()]
    images = [view.image for view in views]
    no_points = np.zeros((0, 3))
    setup = prepare(views, no_points, no_points, StreamConfig())
    background = over_border(setup, images).config.render.background
    assert_allclose(background, mean_color(views), atol=1e-6)
    (message,) = caplog.messages
    assert message.startswith("no points: the background is the mean colour of the images, (0.")
    given = replace(setup, config=StreamConfig(render=RenderConfig(background=(1, 1, 1))))
    assert over_border(given, images) is given
