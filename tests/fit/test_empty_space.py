"""The space in front of the training cameras in which nothing stands."""

from dataclasses import replace

import numpy as np

from morgs_mi.fit.initialise import in_empty_space
from tests.scenes.cameras import look_at_cameras


def test_in_empty_space__is_the_view_before_the_near_plane():
    (camera,) = look_at_cameras([(0, 0, -3)], 60)
    means = np.array([(0, 0, -2.5), (0, 0, -1.5), (0, 0, -3.5), (0.2, 0, -2.5), (0.5, 0, -2.5)])
    expected = [True, False, False, True, False]
    assert in_empty_space([replace(camera, near=1.0)], means).tolist() == expected


def test_in_empty_space__is_that_of_any_camera():
    cameras = [replace(c, near=1.0) for c in look_at_cameras([(0, 0, -3), (0, 0, 3)], 60)]
    means = np.array([(0, 0, -2.5), (0, 0, 2.5), (0, 0, 0.0)])
    assert in_empty_space(cameras, means).tolist() == [True, True, False]
    assert not in_empty_space([], means).any()
    assert in_empty_space(cameras, means[:0]).shape == (0,)
