"""Disturbed cameras, and the errors of cameras after the best alignment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.reports.cameras import disturbed, pose_errors
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import scene_extent
from tests.scenes.textured import rig


def moved(camera: Camera) -> Camera:
    """Return the camera after a similarity of the world."""
    R = Rotation.from_euler("xyz", (20, -30, 50), degrees=True).as_matrix()
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ R.T
    viewmat[:3, 3] = -viewmat[:3, :3] @ (2 * R @ camera.position + (1, 2, 3))
    return replace(camera, viewmat=viewmat)


def test_disturbed__turns_and_displaces_every_camera_as_far_as_it_should():
    true = rig()
    wrong = disturbed(true, 0.5, 0)
    for true_camera, wrong_camera in zip(true, wrong, strict=True):
        turn = Rotation.from_matrix(wrong_camera.viewmat[:3, :3] @ true_camera.viewmat[:3, :3].T)
        assert np.rad2deg(turn.magnitude()) == pytest.approx(0.5)
        assert np.linalg.norm(wrong_camera.position - true_camera.position) == pytest.approx(
            0.005 * scene_extent(true)
        )
        assert abs(wrong_camera.K[0, 0] / true_camera.K[0, 0] - 1) == pytest.approx(0.01)


def test_pose_errors__are_those_after_the_best_rotation():
    true = rig()
    assert max(pose_errors([moved(camera) for camera in true], true).values()) < 1e-4
    assert pose_errors(disturbed(true, 0.5, 0), true)["rotation"] == pytest.approx(0.5, rel=0.3)
