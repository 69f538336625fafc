"""Features and matches: their places, the points behind them, and matches without a common
geometry.
"""

import numpy as np

from morgs_mi.capture.points import triangulate_points
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import seen_points
from morgs_mi.fit.features import (
    Features,
    detect,
    match_views,
)
from tests.scenes import textured


def test_match_views__returns_none_for_matches_without_a_common_geometry():
    """Matches for which OpenCV's estimator of the fundamental matrix raises an error."""
    rng = np.random.default_rng(257)
    count = int(rng.integers(16, 24))
    points = rng.uniform(0, 96, (count, 2)).round(1)
    places = points + rng.normal(0, 3, (count, 2))
    descriptors = np.eye(count, 128, dtype=np.float32)
    features = [
        Features(p, descriptors, np.zeros((count, 3), np.float32), places - points)
        for p in (points, places)
    ]
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 60, 96, 72)
    assert match_views(features, [camera, camera]).matches == ()


def test_detect__finds_a_blob_at_its_position():
    """A blob at a known position, at several image sizes: pixel centres lie at +0.5."""
    for scale in (1, 10):
        place = np.array([70.3, 52.6]) * scale
        x, y = np.meshgrid(np.arange(160 * scale) + 0.5, np.arange(120 * scale) + 0.5)
        squares = (x - place[0]) ** 2 + (y - place[1]) ** 2
        blob = 120 + 120 * np.exp(-squares / (2 * (4 * scale) ** 2))
        points = detect(np.repeat(blob[..., None], 3, -1).astype(np.uint8)).points
        assert np.linalg.norm(points - place, axis=1).min() < 0.1 * scale


def test_detect__respects_the_mask(textured_capture):
    image = next(textured_capture.frames()).images[0]
    mask = np.zeros(image.shape[:2], bool)
    mask[:, 160:] = True
    assert detect(image, mask).points[:, 0].min() > 158


def test_triangulated__finds_points_on_the_planes(textured_capture, textured_features):
    points, colors = textured_features.triangulated(textured_capture.cameras, 2.0)
    assert points.dtype == colors.dtype == np.float32
    assert len(points) > 1000
    # 0.1 px at 4 units, 277 px focal length and a base of 0.5 is 1 cm; a few points at occlusion
    # edges are wrong.
    distance = textured.distance_to_planes(points)
    assert np.percentile(distance, 90) < 0.05
    assert np.percentile(distance, 98) < 0.3
    # Their colours are the colours of the pixels onto which they project.
    image = next(textured_capture.frames()).images[2]
    mask, pixels, _ = seen_points(textured_capture.cameras[2], points)
    u, v = pixels.astype(int).T
    assert np.median(np.abs(image[v, u] / 255 - colors[mask])) < 0.05


def test_triangulated__leaves_out_points_with_a_small_angle(
    textured_capture, textured_features, monkeypatch
):
    counts = []
    for angle in (1, 20, 60):
        monkeypatch.setattr("morgs_mi.fit.features.MIN_ANGLE", angle)
        counts.append(len(triangulate_points(textured_capture, textured_features).points))
    assert counts[0] > counts[1] > counts[2] == 0
