"""Near planes that follow the scene."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.rig import check_near_planes, scene_extent, with_near_planes
from morgs_mi.testing import assert_close
from tests.scenes.cameras import arc, circle, look_at_cameras

NO_POINTS = np.zeros((0, 3))


def slab():
    """Return points [500, 3] at depths 2 to 3 of a camera at z = -3 that looks along +z."""
    rng = np.random.default_rng(0)
    return rng.uniform((-0.5, -0.4, -1), (0.5, 0.4, 0), (500, 3))


def nears(cameras, points=NO_POINTS):
    return np.array([camera.near for camera in with_near_planes(cameras, points)])


def test_with_near_planes__need_a_camera():
    with pytest.raises(ValueError, match="`cameras` must be at least one"):
        with_near_planes([], slab())


def test_with_near_planes__are_a_fifth_of_the_smallest_depth_or_as_given():
    camera = look_at_cameras([(0, 0, -3)])
    wrong = np.tile([0, 0, -2.99], (4, 1))
    assert 0.2 * 1.99 < nears(camera, np.concatenate([slab(), wrong]))[0] <= 0.2 * 2.05
    assert with_near_planes(camera, slab(), 0.7)[0].near == 0.7


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("points", [NO_POINTS, slab()], ids=["rig", "points"])
def test_with_near_planes__scale_with_the_world(scale, points):
    cameras = look_at_cameras(arc((-0.3, 0, 0.3), 3.0))
    units = np.ones((4, 4))
    units[:3, 3] = scale
    scaled = nears([replace(c, viewmat=c.viewmat * units) for c in cameras], scale * points)
    assert_close(scaled, scale * nears(cameras, points), rtol=1e-6)


def test_with_near_planes__without_points_follow_the_focus_of_a_dome():
    cameras = look_at_cameras(circle(np.arange(8) * np.pi / 4, 2.7), up=(0, 0, 1))
    assert_close(nears(cameras), 0.2 * np.hypot(2.7, 0.5), rtol=1e-3)


def test_with_near_planes__without_points_stay_within_the_rig_of_a_far_scene():
    cameras = look_at_cameras([(x, 0, -50.0) for x in (-0.5, 0, 0.5)])
    assert_close(nears(cameras), 0.2 * scene_extent(cameras), rtol=1e-6)


def test_with_near_planes__of_parallel_cameras_follow_the_distance_to_the_next_one():
    origins = [(x, 0.0, -3.0) for x in (0.0, 0.1, 0.3)]
    cameras = [look_at_cameras([(x, y, z)], target=(x, y, 0))[0] for x, y, z in origins]
    assert_close(nears(cameras), 0.2 * np.array([0.1, 0.1, 0.2]), rtol=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_with_near_planes__are_unchanged_if_all_cameras_are_at_one_place(count):
    cameras = [look_at_cameras([(0, 0, -3)], target=(x, 0, 0))[0] for x in range(count)]
    assert nears(cameras).tolist() == [0.01] * count


@pytest.mark.parametrize("points", [NO_POINTS, slab()], ids=["rig", "points"])
def test_check_near_planes__refuses_planes_behind_the_scene(points):
    cameras = look_at_cameras(arc((-0.3, 0.3), 3.0))
    check_near_planes("here", cameras, points)
    hidden = [replace(camera, near=5.0) for camera in cameras]
    with pytest.raises(
        ValueError, match=r"here: the near planes .* got 5 world units where it is .* away"
    ):
        check_near_planes("here", hidden, points)
    check_near_planes("here", with_near_planes(hidden, points), points)
