"""Matching with known poses."""

from dataclasses import replace

import numpy as np

from morgs_mi.capture.features import reprojection_errors
from morgs_mi.capture.guided_matching import match_guided
from tests.scenes.textured import turned


def test_match_guided__finds_true_matches(textured_capture, textured_features):
    features = textured_features.features
    cameras = textured_capture.cameras
    (match,) = match_guided(features, cameras, [(0, 4)])
    assert match.views == (0, 4)
    assert len(match.features) > 100
    assert reprojection_errors(match, features, cameras).max() < 1
    free = next(m for m in textured_features.matches if m.views == (0, 4))
    partners = dict(free.features[reprojection_errors(free, features, cameras) < 0.2].tolist())
    assert np.mean([partners[a] == b for a, b in match.features.tolist() if a in partners]) > 0.95


def test_match_guided__finds_next_to_nothing_with_wrong_poses(textured_capture, textured_features):
    features = textured_features.features
    cameras = textured_capture.cameras
    (true,) = match_guided(features, cameras, [(0, 4)])
    wrong = [turned(camera, 90) if view == 4 else camera for view, camera in enumerate(cameras)]
    assert sum(len(m.features) for m in match_guided(features, wrong, [(0, 4)])) < 0.05 * len(
        true.features
    )
    assert match_guided(features, [cameras[0]] * 6, [(0, 4)]) == []


def test_match_guided__rejects_patches_of_another_size_or_orientation(
    textured_capture, textured_features
):
    features = list(textured_features.features)
    cameras = textured_capture.cameras
    (true,) = match_guided(features, cameras, [(0, 4)])
    for axes in (2 * features[4].axes, features[4].axes[:, ::-1] * (-1, 1)):
        features[4] = replace(textured_features.features[4], axes=axes)
        assert sum(len(m.features) for m in match_guided(features, cameras, [(0, 4)])) < 0.05 * len(
            true.features
        )
