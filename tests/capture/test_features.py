"""Matches between views, where they fit no common geometry."""

from __future__ import annotations

import numpy as np

from morgs_mi.capture.features import Features, match_views
from morgs_mi.core.camera import Camera


def test_match_views__returns_none_for_matches_without_a_common_geometry():
    """Matches for which OpenCV's estimator of the fundamental matrix raises an error."""
    rng = np.random.default_rng(257)
    count = int(rng.integers(16, 24))
    points = rng.uniform(0, 96, (count, 2)).round(1)
    moved = points + rng.normal(0, 3, (count, 2))
    descriptors = np.eye(count, 128, dtype=np.float32)
    features = [Features(p, descriptors, np.zeros((count, 3), np.float32)) for p in (points, moved)]
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 60, 96, 72)
    assert match_views(features, [camera, camera]) == []
