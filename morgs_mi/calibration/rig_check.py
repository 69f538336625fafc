"""Check of the camera poses against feature matches, which are found without the poses.

A wrong order of the cameras, swapped axes and inverted poses are the most common calibration mistakes. If the poses do
not fit the images, each of these is tried, and reported if it explains the matches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.features import Features, Match, detect, match_views, reprojection_errors, triangulate
from morgs_mi.capture.layouts import poses_bounds
from morgs_mi.capture.layouts.calibration import PoseConvention
from morgs_mi.capture.layouts.registry import layout_called
from morgs_mi.core.camera import Camera

__all__ = ["MAX_ERROR", "RigCheck", "SharedFeatures", "check_rig", "match_capture", "triangulate_points"]

# px. Distortion that a layout cannot represent causes errors of about a pixel, a wrong pose tens of pixels.
MAX_ERROR = 2.0
# With a wrong pose a handful of matches may fit by chance, but not this many.
_MIN_MATCHES = 50
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Corrects a camera whose columns right, up were read as down, right.
_UPRIGHT = np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_AXES = {"OpenCV": "OpenCV's axes (x right, y down, z forward)", "OpenGL": "OpenGL's axes (x right, y up, z backward)"}


@dataclass(frozen=True)
class RigCheck:
    """Result of checking the poses on the first frame.

    Attributes:
        matches: number of matches, over all pairs of views.
        pairs: number of pairs of views with matches.
        error: median reprojection error, px; NaN without matches.
        camera_matches: [C] number of matches of each camera.
        camera_errors: [C] median reprojection error of each camera's matches, px; NaN without matches, infinite if
            most of their points lie behind a camera.
        fits: whether the poses fit the images; None if there are too few matches to decide.
        advice: one sentence with the result and a remedy.
    """

    matches: int
    pairs: int
    error: float
    camera_matches: np.ndarray
    camera_errors: np.ndarray
    fits: bool | None
    advice: str


@dataclass(frozen=True)
class SharedFeatures:
    """Features of a capture's first frame and their matches between views.

    Attributes:
        features: per camera.
        matches: per pair of cameras with matches.
    """

    features: tuple[Features, ...]
    matches: tuple[Match, ...]


def match_capture(capture: Capture, progress: Callable[[int, int], None] | None = None) -> SharedFeatures:
    """Return the features and matches of the first frame; takes about 0.6 s per view and 0.03 s per pair.

    A view without an image has no features.

    Args:
        capture: a capture at any size; errors are in its pixels.
        progress: called with (views done, views).
    """
    images, count = next(capture.partial_frames(0, 1)).images, len(capture.cameras)
    features = []
    for done, (image, mask) in enumerate(zip(images, capture.masks, strict=True)):
        if progress is not None:
            progress(done, count)
        features.append(detect(image, mask))
    matches = match_views(features, capture.cameras)
    if progress is not None:
        progress(count, count)
    return SharedFeatures(tuple(features), tuple(matches))


def check_rig(capture: Capture, shared: SharedFeatures) -> RigCheck:
    """Return how well the capture's cameras fit the matches between its views."""
    errors, counts, by_camera = _errors(shared, capture.cameras)
    error = float(np.median(errors)) if len(errors) else float("nan")
    fits, advice = _fits_and_advice(capture, shared, by_camera, counts)
    return RigCheck(len(errors), len(shared.matches), error, counts, by_camera, fits, advice)


def triangulate_points(capture: Capture, shared: SharedFeatures) -> Capture:
    """Return the capture with its points replaced by ones triangulated from its training views.

    Views that share few features give few points or none, which the fit reports. The held-out view is not used.
    """
    matches = [match for match in shared.matches if capture.test_view not in match.views]
    points, colors = triangulate(matches, shared.features, capture.cameras, MAX_ERROR)
    return replace(capture, points=points, point_colors=colors)


def _errors(shared: SharedFeatures, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors of all matches, and per camera the number of its matches and their median error."""
    errors = [reprojection_errors(match, shared.features, cameras) for match in shared.matches]
    of_pairs: list[list[np.ndarray]] = [[] for _ in cameras]
    for match, values in zip(shared.matches, errors, strict=True):
        for view in match.views:
            of_pairs[view].append(values)
    of_camera = [np.concatenate([np.zeros(0), *values]) for values in of_pairs]
    medians = np.array([np.median(values) if len(values) else np.nan for values in of_camera])
    return np.concatenate([np.zeros(0), *errors]), np.array([len(v) for v in of_camera]), medians


def _fits_and_advice(
    capture: Capture, shared: SharedFeatures, by_camera: np.ndarray, counts: np.ndarray
) -> tuple[bool | None, str]:
    """Return the last two fields of `RigCheck` from the cameras' errors [C] and numbers of matches [C]."""
    if counts.sum() < 2 * _MIN_MATCHES:
        return None, (
            "too few matches to check the poses: the views have little overlap, or the scene has little texture."
        )
    wrong = by_camera > MAX_ERROR
    if not wrong.any():
        alone = [name for name, count in zip(capture.names, counts, strict=True) if not count]
        return True, f"the poses fit the images{'; no match with ' + ', '.join(alone) if alone else ''}."
    for cameras, explanation in _alternatives(capture):
        if not (_errors(shared, cameras)[2] > MAX_ERROR).any():
            return False, f"the poses do not fit the images: {explanation}."
    names = ", ".join(name for name, bad in zip(capture.names, wrong, strict=True) if bad)
    return False, (
        f"the poses of {names} do not fit the images: check the order of the cameras, the camera axes and the image "
        "size of the calibration, or calibrate again with `morgs-mi calibrate`."
    )


def _alternatives(capture: Capture) -> list[tuple[Sequence[Camera], str]]:
    """Return the correct cameras for each common mistake, and the description of the mistake."""
    if capture.layout == poses_bounds.LAYOUT.name:
        return _other_rows(capture)
    layout = layout_called(capture.layout)
    poses = layout.poses if layout else PoseConvention()
    return _other_conventions(capture.cameras, poses) if poses else []


def _other_rows(capture: Capture) -> list[tuple[Sequence[Camera], str]]:
    """Return the alternatives for poses in the rows of `poses_bounds.npy`."""
    cameras, alphabetical = capture.cameras, sorted(capture.names)
    rows = [cameras[alphabetical.index(name)] for name in capture.names]
    turned = [replace(c, viewmat=_UPRIGHT @ c.viewmat) for c in cameras]
    order = ", ".join(alphabetical[:4])
    return [
        (rows, f"the rows seem to be in alphabetical order ({order}, ...); put them in numerical order"),
        (turned, "the columns seem to be the camera's right, up and backward axes; expected down, right, backward"),
    ]


def _other_conventions(cameras: Sequence[Camera], expected: PoseConvention) -> list[tuple[Sequence[Camera], str]]:
    """Return the alternatives for poses in 4x4 matrices.

    Images do not determine a rotation of the world, so there are only four distinguishable conventions: camera to
    world or the inverse, in OpenCV's axes or OpenGL's.
    """
    inverses = [replace(c, viewmat=np.linalg.inv(c.viewmat)) for c in cameras]
    other_axes = "OpenCV" if expected.axes == "OpenGL" else "OpenGL"
    inverse = "world to camera" if expected.direction == "camera to world" else "camera to world"
    found = [
        ([replace(c, viewmat=_FLIP @ c.viewmat) for c in cameras], expected.direction, other_axes),
        (inverses, inverse, "OpenCV"),
        ([replace(c, viewmat=_FLIP @ c.viewmat) for c in inverses], inverse, "OpenGL"),
    ]
    remedy = f"expected {expected.direction} in {_AXES[expected.axes]}; convert them"
    return [
        (cameras, f"the poses seem to be {direction} in {_AXES[axes]}; {remedy}") for cameras, direction, axes in found
    ]
