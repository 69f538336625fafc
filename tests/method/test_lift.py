"""Lifting flow to Gaussians: exact flow gives back the true displacement."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians
from morgs_mi.method.flow import FlowObservation, choose_key_views
from morgs_mi.method.lift import lift_flow, projection_jacobian
from morgs_mi.render.active_view import ActiveView

SHIFT = np.array([0.03, -0.02, 0.015])


def rig(count=4):
    angles = np.linspace(-0.6, 0.6, count)
    origins = [(3 * np.sin(a), 0.5 * (-1) ** i, -3 * np.cos(a)) for i, a in enumerate(angles)]
    return [Camera.look_at(o, (0, 0, 0), (0, -1, 0), 40, 64, 48) for o in origins]


def cloud(n=200, seed=0):
    """A sheet through the origin, so that the flow of one plane is the flow of all."""
    rng = np.random.default_rng(seed)
    means = rng.uniform((-0.5, -0.5, -0.03), (0.5, 0.5, 0.03), (n, 3))
    scales, quats = np.full((n, 3), 0.06), np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians.from_activated(means, scales, quats, np.full(n, 0.8), np.zeros((n, 1, 3)))


def uniform_cue(camera, shift):
    """The flow of a plane at the scene's depth that moves by `shift`."""
    before, after = (camera.project(np.atleast_2d(p))[0][0] for p in (np.zeros(3), shift))
    flow = np.broadcast_to(np.float32(after - before), (camera.height, camera.width, 2)).copy()
    everywhere = np.ones((camera.height, camera.width), bool)
    return FlowObservation(flow, everywhere, flow, everywhere)


def lifted_from(gaussians, cues):
    return lift_flow(gaussians, {view: ActiveView(camera) for view, camera in enumerate(rig())}, cues)


def test_uniform_motion_is_recovered_in_3d():
    cues = {view: uniform_cue(camera, SHIFT) for view, camera in enumerate(rig())}
    lifted = lifted_from(cloud(), cues)
    # The prior of 0.3 px weighs against some 10 px of evidence; a shift along the view shows least.
    error = np.abs(np.median(lifted.displacement, axis=0) - SHIFT) / np.linalg.norm(SHIFT)
    assert error[:2].max() < 0.05
    assert error[2] < 0.1
    assert (lifted.logit_confidence > 0).mean() > 0.98


def test_no_evidence_means_no_motion():
    cue = uniform_cue(rig()[0], SHIFT)
    nowhere = np.zeros_like(cue.forward_reliable)
    for cues in ({}, {0: FlowObservation(cue.motion, nowhere, cue.forward_flow, nowhere)}):
        lifted = lifted_from(cloud(), cues)
        assert np.abs(lifted.displacement).max() == 0
        assert (lifted.logit_confidence < -1).all()


def test_noise_of_the_flow_is_no_motion():
    """A tenth of a pixel, as smooth as flow is, independent in every view."""
    rng, cues = np.random.default_rng(0), {}
    for view, camera in enumerate(rig()):
        flow = cv2.resize(rng.normal(0, 0.1, (6, 8, 2)), (camera.width, camera.height)).astype(np.float32)
        everywhere = np.ones((camera.height, camera.width), bool)
        cues[view] = FlowObservation(flow, everywhere, flow, everywhere)
    lifted = lifted_from(cloud(), cues)
    assert (lifted.logit_confidence < 0).all()
    assert np.abs(lifted.displacement).max() == 0


def test_one_view_that_errs_does_not_convince_the_others():
    """Flow bleeds in one of four views: who stands still stays, who moves goes where the three others say."""
    cameras = rig()
    for truth in (np.zeros(3), SHIFT):
        cues = {view: uniform_cue(camera, truth) for view, camera in enumerate(cameras)}
        wrong = np.full_like(cues[2].forward_flow, 6.0)
        cues[2] = replace(cues[2], forward_flow=wrong)
        lifted = lifted_from(cloud(), cues)
        error = np.linalg.norm(np.median(lifted.displacement, axis=0) - truth)
        # Without the rounds of reweighting it is 0.6 to 0.7 of the motion.
        assert error < 0.15 * np.linalg.norm(SHIFT)
        assert (lifted.logit_confidence > 0).mean() > 0.95 if truth.any() else (lifted.logit_confidence < 0).all()


def test_jacobian_agrees_with_central_differences():
    camera, h = rig()[1], 1e-5
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (6, 3))
    J = projection_jacobian(camera, points)
    for k in range(3):
        step = h * np.eye(3)[k]
        difference = (camera.project(points + step)[0] - camera.project(points - step)[0]) / (2 * h)
        assert J[:, :, k] == pytest.approx(difference, rel=1e-6, abs=1e-6)


def test_key_views_are_spread_and_distinct():
    cameras = rig(9)
    chosen = choose_key_views(cameras, 4)
    assert len(set(chosen)) == 4
    assert {0, 8} <= set(chosen)
    assert choose_key_views(cameras, 20) == tuple(range(9))
