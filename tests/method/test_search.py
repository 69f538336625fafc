"""Coarse search: parts that move farther than they are wide."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.search import (
    _matching_cost,
    _reduction,
    search_motion,
)
from morgs_mi.render.active_view import ActiveView
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet
from tests.scenes.views import rendered_as

SHIFT = np.float32([0.15, 0.05, 0.08])  # 12 px; the rod is 6 px wide
ROD = 24
WALL = 1500
MOVES = np.arange(ROD + WALL) < ROD


@pytest.fixture(scope="module")
def scene():
    """A bright thin rod, of a few Gaussians, in front of a textured wall, in three views."""
    rng = np.random.default_rng(0)
    heights = np.repeat(np.linspace(-0.4, 0.4, ROD // 2), 2) + np.tile([-0.01, 0.01], ROD // 2)
    rod = np.stack([np.zeros(ROD), heights, np.full(ROD, -0.4)], axis=1)
    colors = np.concatenate(
        [rng.uniform(0.8, 1.5, (ROD, 1, 3)), rng.uniform(-1.5, -0.5, (WALL, 1, 3))]
    )
    gaussians = isotropic(
        np.concatenate([rod, random_sheet(rng, WALL, 1.2, 0.6)]), 0.04, 0.95, colors
    )
    places = [(x, 0.3, -3) for x in (-1, 0.1, 1.2)]
    return gaussians, dict(enumerate(map(ActiveView, look_at_cameras(places, 45, 160, 120))))


def moved(gaussians, shift=SHIFT):
    return replace(gaussians, means=np.asarray(gaussians.means) + shift * MOVES[:, None])


def start_of(shift=0 * SHIFT, logit=-2):
    """Return a motion and a confidence of the rod."""
    return MotionStart(
        (shift * MOVES[:, None]).astype(np.float32), np.where(MOVES, logit, -2).astype(np.float32)
    )


def searched(scene, start, visible=None):
    """Search in the images of the Gaussians that are visible: by default the moved ones."""
    gaussians, views = scene
    seen = rendered_as(moved(gaussians) if visible is None else visible, views)
    problem = MotionProblem(gaussians, seen, np.random.default_rng(0))
    return search_motion(problem, start)


@pytest.mark.parametrize("shift", [SHIFT, -SHIFT, SHIFT * [1, 1, -2]])
def test_search_motion__finds_a_fast_thin_part(scene, shift):
    motion = searched(scene, start_of(), moved(scene[0], shift))
    distance = np.linalg.norm(motion.displacement[MOVES] - shift, axis=1)
    assert np.all(distance < 0.1 * np.linalg.norm(shift))
    assert not motion.displacement[~MOVES].any()
    assert np.allclose(motion.logit_confidence[MOVES], 0.3)
    assert np.all(motion.logit_confidence[~MOVES] == -2)


def test_search_motion__keeps_a_start_that_explains_the_images(scene):
    right = start_of(SHIFT, 1)
    assert searched(scene, right) is right


def test_search_motion__keeps_a_part_that_vanished(scene):
    start = start_of()
    assert searched(scene, start, scene[0].select(np.flatnonzero(~MOVES))) is start


@pytest.mark.parametrize(
    ("threshold", "value"),
    [
        ("_UNEXPLAINED", 1e3),
        ("NEIGHBOURS", 1),  # the rod is a row of pairs
        ("_MIN_SIZE", ROD + 1),
        ("_COST_RATIO", 0.0),
        ("_ERROR_RATIO", 0.0),
        ("_REACH", 0.03),
        ("_MAX_PARTS", 0),
    ],
)
def test_search_motion__each_threshold_can_prevent_a_finding(scene, monkeypatch, threshold, value):
    start = start_of()
    monkeypatch.setattr(f"morgs_mi.method.search.{threshold}", value)
    assert searched(scene, start) is start


def test_initial_motion__searches_where_flow_sees_nothing(scene):
    gaussians, views = scene
    flow = np.zeros((120, 160, 2), np.float32), np.ones((120, 160), bool)
    flows = {v: FlowObservation(*flow, *flow) for v in views}
    active = ActiveSet(np.arange(len(MOVES)), len(MOVES), views, len(views))
    for searches in (True, False):
        config = MotionConfig(search_motion=searches)
        rng = np.random.default_rng(0)
        seen = rendered_as(moved(gaussians), views, flows)
        initial = initial_motion(gaussians, active, seen, config, rng)
        assert initial.displacement[MOVES].any() == searches


def test_matching_cost__is_the_weighted_squared_difference():
    rng = np.random.default_rng(0)
    image, next_image = rng.random((2, 48, 64, 3)).astype(np.float32)
    weight = np.zeros((48, 64), np.float32)
    weight[20:26, 30:35] = rng.random((6, 5))
    cost = _matching_cost(next_image, image, weight)
    middle = len(cost) // 2
    for x, y in ((0, 0), (4, -3), (-11, 9)):
        squares = np.square(np.roll(next_image, (-y, -x), (0, 1)) - image)
        expected = np.sum(weight[..., None] * squares)
        assert cost[middle + y, middle + x] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("width", "block", "factor"),
    [(1352, (8, 4), 4), (1352, (4, 2), 2), (700, (8, 4), 2), (160, (8, 4), 1)],
)
def test_reduction__leaves_two_pixels_per_step_and_divides_the_blocks(width, block, factor):
    assert _reduction(width, block) == factor
