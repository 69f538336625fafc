"""Points of a capture from its first frame: matched features, triangulated, and stereo points where
cameras are close.

Features are found at the recorded size, and pixels refer to that size, even if the capture is
downscaled. Smaller images have fewer and less exact features.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.features import SharedFeatures, detect, match_views
from morgs_mi.fit.image_points import matched_points
from morgs_mi.fit.stereo import stereo_points
from morgs_mi.platform.progress import StepReport, unreported


def match_capture(capture: Capture, progress: StepReport = unreported) -> SharedFeatures:
    """Return the features of the first frame, in pixels of the recorded size, and their matches.

    It takes about 0.6 s per view and 0.03 s per pair.

    A view without an image has no features.

    Args:
        capture: a capture, downscaled or not.
        progress: called with (views done, views).
    """
    capture = capture.displayed().at_recorded_size()
    views = next(capture.partial_frames(0, 1)).views
    features = []
    for view in views:
        progress(len(features), len(views))
        features.append(detect(view.image if view.has_image else None, view.mask))
    shared = match_views(features, capture.cameras)
    progress(len(views), len(views))
    return shared


def triangulate_points(capture: Capture, shared: SharedFeatures) -> Capture:
    """Return the capture with points triangulated from its training views instead of its own.

    Views with few matches are also matched by their poses. Views that share few features give few
    points or none, which the fit reports. Held-out views are not used.
    """
    cameras = capture.at_recorded_size().cameras
    points, colors = matched_points(shared.without(capture.test_views), cameras)
    return replace(capture, points=points, point_colors=colors)


def dense_points(capture: Capture, sparse: Capture, seed: int = 0) -> Capture:
    """Return the capture with the points of `sparse`, see `triangulate_points`, and with stereo
    points where cameras are close.

    Args:
        capture: a capture; its held-out view is not used.
        sparse: the capture with triangulated points.
        seed: seed of the selection of stereo points.
    """
    recorded = capture.at_recorded_size()
    train = next(recorded.displayed().partial_frames(0, 1)).views.train
    views = [view for view in train if view.has_image]
    points, colors = stereo_points(views, sparse.points, rng_of(seed, Stream.POINTS))
    points = np.concatenate([sparse.points, points])
    colors = np.concatenate([sparse.point_colors, colors])
    return replace(capture, points=points, point_colors=colors)
