"""Lifted flow: exact flow gives the true displacement, also with noise or one wrong view."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.rig import choose_key_views
from morgs_mi.method.flow import FlowObservation, ViewFlow
from morgs_mi.method.lift import lift_flow
from morgs_mi.render.active_view import ActiveView
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic

SHIFT = np.array([0.03, -0.02, 0.015])


def rig(count=4):
    angles = np.linspace(-0.6, 0.6, count)
    origins = [(x, 0.5 * (-1) ** i, z) for i, (x, _, z) in enumerate(arc(angles, 3))]
    return look_at_cameras(origins, 40)


def cloud(n=200, seed=0):
    """A sheet through the origin: the flow of one plane is the flow of all."""
    rng = np.random.default_rng(seed)
    means = rng.uniform((-0.5, -0.5, -0.03), (0.5, 0.5, 0.03), (n, 3))
    return isotropic(means, 0.06, 0.8)


def uniform_flow(camera, shift):
    """The flow of a plane at the scene's depth that moves by `shift`."""
    start, end = (camera.project(p)[0] for p in (np.zeros(3), shift))
    flow = np.broadcast_to(np.float32(end - start), (camera.height, camera.width, 2)).copy()
    everywhere = np.ones((camera.height, camera.width), bool)
    return FlowObservation(flow, everywhere, flow, everywhere)


def lifted_from(gaussians, flows):
    cameras = rig()
    return lift_flow(
        gaussians, [ViewFlow(ActiveView(cameras[v]), flow) for v, flow in flows.items()]
    )


def test_lift_flow__recovers_a_translation():
    flows = {view: uniform_flow(camera, SHIFT) for view, camera in enumerate(rig())}
    lifted = lifted_from(cloud(), flows)
    # The prior weighs 0.3 px against some 10 px of flow; a shift along the view shows least.
    error = np.abs(np.median(lifted.displacement, axis=0) - SHIFT) / np.linalg.norm(SHIFT)
    assert error[:2].max() < 0.05
    assert error[2] < 0.1
    assert (lifted.logit_confidence > 0).mean() > 0.98


def test_lift_flow__gives_no_motion_without_observations():
    flow_of_view = uniform_flow(rig()[0], SHIFT)
    nowhere = np.zeros_like(flow_of_view.forward_reliable)
    for flows in (
        {},
        {0: FlowObservation(flow_of_view.motion, nowhere, flow_of_view.forward_flow, nowhere)},
    ):
        lifted = lifted_from(cloud(), flows)
        assert np.abs(lifted.displacement).max() == 0
        assert (lifted.logit_confidence < -1).all()


def test_lift_flow__is_robust_to_one_wrong_view():
    """Flow bleeds in one of four views: the result follows the three others, with and without
    motion.
    """
    cameras = rig()
    for truth in (np.zeros(3), SHIFT):
        flows = {view: uniform_flow(camera, truth) for view, camera in enumerate(cameras)}
        wrong = np.full_like(flows[2].forward_flow, 6.0)
        flows[2] = replace(flows[2], forward_flow=wrong)
        lifted = lifted_from(cloud(), flows)
        error = np.linalg.norm(np.median(lifted.displacement, axis=0) - truth)
        # Without the rounds of reweighting it is 0.6 to 0.7 of the motion.
        assert error < 0.15 * np.linalg.norm(SHIFT)
        assert (
            (lifted.logit_confidence > 0).mean() > 0.95
            if truth.any()
            else (lifted.logit_confidence < 0).all()
        )


def test_choose_key_views__are_spread_and_distinct():
    cameras = rig(9)
    chosen = choose_key_views(cameras, 4)
    assert len(set(chosen)) == 4
    assert {0, 8} <= set(chosen)
    assert choose_key_views(cameras, 20) == tuple(range(9))


def test_choose_key_views__by_name():
    cameras = [replace(camera, name=f"cam{i:02d}") for i, camera in enumerate(rig(9))]
    assert choose_key_views(cameras, ("cam08", "cam01", "cam04")) == (1, 4, 8)
    with pytest.raises(ValueError, match=r"`motion.key_views` must be an index .*, got 'cam13'"):
        choose_key_views(cameras, ("cam01", "cam13"))
