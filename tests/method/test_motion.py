"""The start of the motion: its stages, one after the other."""

from dataclasses import replace

import mitsuba as mi
import numpy as np

from morgs_mi import RenderConfig
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.motion import STARTS, initial_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.render.rasterize import render_view
from tests.scenes.ball import opaque_ball, views
from tests.scenes.views import rendered_as

SHIFT = np.float32([0.06, -0.03, 0.02])


def start(config, with_flow=True):
    """Return the start of a ball that moves by `SHIFT`, of which the flow sees two thirds."""
    ball = opaque_ball()
    previous_gaussians = replace(ball, logit_confidence=np.ones(len(ball)))
    moved_gaussians = replace(ball, means=mi.TensorXf(np.asarray(ball.means) + SHIFT))
    active = full_active_set(previous_gaussians, dict(enumerate(views())), RenderConfig())
    shown = replace(ball, motion=np.tile(2 / 3 * SHIFT, (len(ball), 1)))
    flows = {}
    for v, view in active.views.items():
        flow = np.asarray(render_view(shown, view, ("motion",))["motion"])
        is_reliable = np.ones(flow.shape[:2], bool)
        if with_flow:
            flows[v] = FlowObservation(flow, is_reliable, flow, is_reliable)
    seen = rendered_as(moved_gaussians, active.views, flows)
    rng = np.random.default_rng(0)
    return initial_motion(previous_gaussians, active, seen, config, rng)


def test_initial_motion__runs_the_stages_that_are_on():
    off = replace(MotionConfig(), propagate_motion=False, search_motion=False, refine_start=False)
    assert all(hasattr(off, name) for name in STARTS)
    lifted = start(off)
    motion = start(MotionConfig())
    assert lifted.color_change is None
    moves = lifted.displacement.any(axis=1)  # the others are hidden
    error, refined_error = (
        np.median(np.linalg.norm(s.displacement[moves] - SHIFT, axis=1)) for s in (lifted, motion)
    )
    assert refined_error < 0.5 * error < 0.5 * np.linalg.norm(SHIFT)
    assert motion.color_change is not None


def test_initial_motion__has_no_motion_without_flow():
    still = start(MotionConfig(), with_flow=False)
    assert not still.displacement.any()
    assert still.color_change is None
