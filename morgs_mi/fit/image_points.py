"""Points of images with known cameras: matched features, triangulated, and stereo points where
cameras are close.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.view import View
from morgs_mi.fit.features import SharedFeatures, detect, match_views
from morgs_mi.fit.guided_matching import match_guided
from morgs_mi.fit.stereo import stereo_points

# px. Distortion that a layout cannot represent causes errors of about a pixel, a wrong pose tens of
# pixels.
MAX_ERROR = 2.0
# A view that matches fewer others without its pose is also matched with it, which takes longer.
_MIN_PARTNERS = 3


def image_points(views: Sequence[View], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [P, 3] that the images show, world units, and their colours [P, 3]; none
    where nothing is matched.

    Args:
        views: V views with images of uint8.
        rng: random generator for the selection of stereo points.
    """
    cameras = [view.camera for view in views]
    features = [detect(view.image, view.mask) for view in views]
    sparse, sparse_colors = matched_points(match_views(features, cameras), cameras)
    dense, dense_colors = stereo_points(views, sparse, rng)
    return np.concatenate([sparse, dense]), np.concatenate([sparse_colors, dense_colors])


def matched_points(
    shared: SharedFeatures, cameras: Sequence[Camera]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [P, 3] of matched features, world units, and their colours [P, 3].

    Views with few matches are also matched by their poses.

    Args:
        shared: features of the views and their matches, from `match_views`.
        cameras: per view.
    """
    views = range(len(cameras))
    # Unmatched pairs of views that match few others.
    matched_pairs = {match.views for match in shared.matches}
    partners = Counter(view for pair in matched_pairs for view in pair)
    few = {view for view in views if partners[view] < _MIN_PARTNERS}
    guided = match_guided(
        shared,
        cameras,
        [pair for pair in combinations(views, 2) if pair not in matched_pairs and few & set(pair)],
    )
    shared = replace(shared, matches=(*shared.matches, *guided))
    return shared.triangulated(cameras, MAX_ERROR)
