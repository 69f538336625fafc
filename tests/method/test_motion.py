"""The start of the motion: its stages, one after the other."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from morgs_mi import RenderConfig
from morgs_mi.method import cohesion
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.motion import STARTS, initial_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.ssim import Target
from tests.scenes.ball import opaque_ball, views

SHIFT = np.float32([0.06, -0.03, 0.02])


def start(config, with_flow=True):
    """Return the start of a ball that goes on moving by `SHIFT`, without any flow."""
    ball = opaque_ball()
    previous_gaussians = replace(
        ball, motion=np.tile(SHIFT, (len(ball), 1)), logit_confidence=np.ones(len(ball))
    )
    moved_gaussians = replace(ball, means=mi.TensorXf(np.asarray(ball.means) + SHIFT))
    active = full_active_set(previous_gaussians, dict(enumerate(views())), RenderConfig())
    targets = {
        v: Target(np.asarray(view.render(moved_gaussians).color))
        for v, view in active.views.items()
    }
    flow = (
        np.zeros((*targets[0].image().shape[:2], 2), np.float32),
        np.ones(targets[0].image().shape[:2], bool),
    )
    flows = {v: FlowObservation(*flow, *flow) for v in active.views if with_flow}
    return initial_motion(
        previous_gaussians, active, flows, targets, config, np.random.default_rng(0)
    )


def test_initial_motion__runs_the_stages_that_are_on():
    off = replace(MotionConfig(), propagate_motion=False, search_motion=False, refine_start=False)
    assert all(hasattr(off, name) for name in STARTS)
    lifted = start(off)
    motion = start(MotionConfig())
    assert not lifted.displacement.any()  # the flow sees no motion
    assert lifted.color_change is None
    assert np.linalg.norm(motion.displacement - SHIFT, axis=1).mean() < 0.5 * np.linalg.norm(SHIFT)
    assert motion.color_change is not None


def test_initial_motion__builds_one_index_of_the_neighbours(monkeypatch):
    """The stages and the cohesion share it; the search has its own, of displaced Gaussians."""
    built = []
    monkeypatch.setattr(cohesion, "KDTree", lambda points, **_: built.append(0) or KDTree(points))
    start(replace(MotionConfig(), search_motion=False))
    assert len(built) == 1


def test_initial_motion__has_no_motion_without_flow():
    still = start(MotionConfig(), with_flow=False)
    assert not still.displacement.any()
    assert still.color_change is None
