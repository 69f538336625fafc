"""Do the poses fit the pictures? A check against matches that were found without looking at the poses.

A wrong order of cameras, swapped axes and inverted poses are the usual ways to lose a calibration: where the poses do
not fit, each of these is tried, and named if it explains the pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.features import Features, Match, detect, match_views, reprojection_errors, triangulate
from morgs_mi.core.camera import Camera

__all__ = ["MAX_ERROR", "Common", "RigCheck", "check_rig", "match_capture", "triangulate_points"]

# Distortion that a layout cannot express costs about a pixel; a wrong pose costs tens.
MAX_ERROR = 2.0
# A wrong pose lets a handful of matches fit by chance, not this many.
_MIN_MATCHES = 50
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# From a camera whose right and down were read where right and up are, to what it is.
_UPRIGHT = np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_OPENGL, _OPENCV = "OpenGL's axes (x right, y up, z backward)", "OpenCV's (x right, y down, z forward)"


@dataclass(frozen=True)
class RigCheck:
    """What the first frame says about the poses.

    Attributes:
        matches: how many matches there are, over all pairs of views.
        pairs: in how many pairs of views.
        error: median reprojection error, px; NaN without matches.
        camera_matches: [C] matches of each camera.
        camera_errors: [C] median reprojection error of each camera's matches, px; NaN without matches, infinite where
            most of them would lie behind a camera.
        fits: true if they fit, false if not, None if there are too few matches to tell.
        advice: one sentence on it.
    """

    matches: int
    pairs: int
    error: float
    camera_matches: np.ndarray
    camera_errors: np.ndarray
    fits: bool | None
    advice: str


@dataclass(frozen=True)
class Common:
    """What the views of a capture's first frame have in common.

    Attributes:
        features: per camera.
        matches: of pairs of cameras.
    """

    features: tuple[Features, ...]
    matches: tuple[Match, ...]


def match_capture(capture: Capture, progress: Callable[[int, int], None] | None = None) -> Common:
    """Match the views of the first frame: about 0.6 s per view and 0.03 s per pair.

    Args:
        capture: at any size; errors will be in its pixels.
        progress: is called with (views done, views).

    A view without a picture has nothing in common with the others.
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
    return Common(tuple(features), tuple(matches))


def check_rig(capture: Capture, common: Common) -> RigCheck:
    """Compare the capture's cameras with what its views have in common."""
    errors, counts, by_camera = _judge(common, capture.cameras)
    error = float(np.median(errors)) if len(errors) else float("nan")
    fits, advice = _verdict(capture, common, by_camera, counts)
    return RigCheck(len(errors), len(common.matches), error, counts, by_camera, fits, advice)


def triangulate_points(capture: Capture, common: Common) -> Capture:
    """Return the capture with the points that its training views have in common in place of those that it had.

    Where the views have little in common there are few or none, and the fit says so. The held-out view takes no part.
    """
    matches = [match for match in common.matches if capture.test_view not in match.views]
    points, colors = triangulate(matches, common.features, capture.cameras, MAX_ERROR)
    return replace(capture, points=points, point_colors=colors)


def _judge(common: Common, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors of all matches, and per camera how many it has and their median error."""
    errors = [reprojection_errors(match, common.features, cameras) for match in common.matches]
    of_camera: list[list[np.ndarray]] = [[] for _ in cameras]
    for match, values in zip(common.matches, errors, strict=True):
        for view in match.views:
            of_camera[view].append(values)
    everything = [np.concatenate([np.zeros(0), *values]) for values in of_camera]
    medians = np.array([np.median(values) if len(values) else np.nan for values in everything])
    return np.concatenate([np.zeros(0), *errors]), np.array([len(v) for v in everything]), medians


def _verdict(capture: Capture, common: Common, by_camera: np.ndarray, counts: np.ndarray) -> tuple[bool | None, str]:
    if counts.sum() < 2 * _MIN_MATCHES:
        return None, (
            "too few matches to tell whether the poses fit: the views have little in common, or little texture."
        )
    wrong = by_camera > MAX_ERROR
    if not wrong.any():
        alone = [name for name, count in zip(capture.names, counts, strict=True) if not count]
        return True, f"the poses fit the pictures{'; no match with ' + ', '.join(alone) if alone else ''}."
    for cameras, explanation in _alternatives(capture):
        if not (_judge(common, cameras)[2] > MAX_ERROR).any():
            return False, f"the poses do not fit the pictures: {explanation}."
    names = ", ".join(name for name, bad in zip(capture.names, wrong, strict=True) if bad)
    return False, (
        f"the poses of {names} do not fit the pictures: check the order of the cameras, the camera axes and the image "
        "size of the calibration, or calibrate again with `morgs-mi calibrate`."
    )


def _alternatives(capture: Capture) -> list[tuple[list[Camera], str]]:
    """Return what the cameras would be after each usual mistake, and what it is.

    A rotation of the world changes nothing that pictures could tell, so the kinds of poses that may be mistaken for
    each other are four: camera to world or the inverse, in OpenCV's axes or OpenGL's.
    """
    cameras = capture.cameras
    if capture.layout == "poses_bounds":
        alphabetical = sorted(capture.names)
        rows = [cameras[alphabetical.index(name)] for name in capture.names]
        turned = [replace(c, viewmat=_UPRIGHT @ c.viewmat) for c in cameras]
        order = ", ".join(alphabetical[:4])
        return [
            (rows, f"the rows seem to be in alphabetical order ({order}, ...); put them in numerical order"),
            (turned, "the columns seem to be the camera's right, up and backward axes; expected down, right, backward"),
        ]
    inverses = [replace(c, viewmat=np.linalg.inv(c.viewmat)) for c in cameras]
    found = [
        [replace(c, viewmat=_FLIP @ c.viewmat) for c in cameras],
        inverses,
        [replace(c, viewmat=_FLIP @ c.viewmat) for c in inverses],
    ]
    to_world, to_camera = "camera to world", "world to camera"
    if capture.layout == "Nerfstudio":
        expected, others = (to_world, _OPENGL), ((to_world, _OPENCV), (to_camera, _OPENCV), (to_camera, _OPENGL))
    else:
        expected, others = (to_camera, _OPENCV), ((to_camera, _OPENGL), (to_world, _OPENCV), (to_world, _OPENGL))
    remedy = f"expected {expected[0]} in {expected[1]}; convert them"
    return [
        (cameras, f"the poses seem to be {kind} in {axes}; {remedy}")
        for cameras, (kind, axes) in zip(found, others, strict=True)
    ]
