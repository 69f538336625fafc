"""Motion proposals from neighbours, where flow fails."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.method.motion import propagate_motion
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.render.active_view import ActiveView
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet
from tests.scenes.views import rendered_as

SHIFT = np.float32([0.25, -0.1, 0.0])


@pytest.fixture(scope="module")
def scene():
    """A bright clump of 60 in front of a dark wall; the clump moves by SHIFT."""
    rng = np.random.default_rng(0)
    wall = random_sheet(rng, 400, 1.2, 0.6)
    means = np.concatenate([rng.normal(0, 0.12, (60, 3)), wall])
    colors = np.concatenate([rng.uniform(0.5, 1.5, (60, 1, 3)), rng.uniform(-1.5, -1, (400, 1, 3))])
    gaussians = isotropic(means, 0.05, 0.9, colors)
    moves = np.arange(460) < 60
    target = replace(
        gaussians, means=mi.TensorXf(np.asarray(gaussians.means) + SHIFT * moves[:, None])
    )
    cameras = look_at_cameras([(x, 0.3, -3) for x in (-0.8, 0.8)], 45)
    views = {view: ActiveView(camera) for view, camera in enumerate(cameras)}
    return gaussians, moves, rendered_as(target, views)


def start(scene, lifted):
    gaussians, _, views = scene
    problem = MotionProblem(gaussians, views, np.random.default_rng(0))
    return propagate_motion(problem, lifted)


def found(lift, moves):
    """Fractions of the moving Gaussians that move by SHIFT, and of the static ones that do not
    move.

    Measured, all are 1 but for one of the 60, which is hardly visible; the bounds below allow for
    two.
    """
    right = np.linalg.norm(lift.displacement - SHIFT * moves[:, None], axis=1) < 0.05
    return right[moves].mean(), right[~moves].mean()


def lift_of(mask):
    """Return the true motion of some Gaussians."""
    return MotionStart(
        (SHIFT * mask[:, None]).astype(np.float32), np.where(mask, 2, -2).astype(np.float32)
    )


def test_propagate_motion__spreads_to_neighbours(scene):
    moves = scene[1]
    lift = start(scene, lift_of(moves & (np.arange(460) % 3 == 0)))
    hit, static = found(lift, moves)
    assert hit > 0.96  # a third to begin with
    assert static > 0.99
    assert (lift.logit_confidence[moves] > 0).mean() > 0.96
    assert (lift.logit_confidence[~moves] < 0).mean() > 0.99


def test_propagate_motion__spreads_no_wrong_motion(scene):
    """Nothing moves in the images, and a third of the clump by the flow."""
    gaussians, moves, views = scene
    views = rendered_as(gaussians, views)
    wrong = moves & (np.arange(460) % 3 == 0)
    displacement = start((gaussians, moves, views), lift_of(wrong)).displacement
    assert not displacement[~wrong].any()


def test_propagate_motion__does_nothing_where_no_view_shows_what_may_move(scene):
    gaussians, moves, views = scene
    outside = replace(gaussians, means=np.asarray(gaussians.means) - np.float32([0, 0, 50]))
    lifted = lift_of(moves)
    assert start((outside, moves, views), lifted) is lifted
