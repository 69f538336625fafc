"""Common mistakes of a calibration, and the poses that would correct them.

A candidate is a pair of corrected cameras and the description of the mistake. The rig check accepts
a candidate that explains the matches between the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, TypeVar

import numpy as np

from morgs_mi.capture.layouts import poses_bounds, reader_registry
from morgs_mi.capture.layouts.calibration import PoseConvention
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import central_distances, positions_of

# A camera or the cameras of a rig.
T = TypeVar("T")

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_ABOUT_FACE = np.diag([-1.0, 1.0, -1.0, 1.0])
# Corrects columns right, up of a camera that were read as down, right.
_UPRIGHT = np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_AXES = {
    "OpenCV": "OpenCV's axes (x right, y down, z forward)",
    "OpenGL": "OpenGL's axes (x right, y up, z backward)",
}
# Share of the rig's radius, and entries of a rotation: neighbours of a dense rig differ by far more
# than this.
_SAME = 1e-3
# Rotations of a single wrong pose, and what is wrong with it.
_UPSIDE_DOWN = (
    "its images are upside down relative to its pose: turn the clip or the pose by 180 degrees"
)
_SIDEWAYS = (
    "its pose is turned by 90 degrees about the optical axis: check the order and signs of its axes"
)
_CAMERA_MISTAKES = (
    (_HALF_TURN, _UPSIDE_DOWN),
    (_UPRIGHT, _SIDEWAYS),
    (_UPRIGHT.T, _SIDEWAYS),
    (_ABOUT_FACE, "its pose looks backward: turn it by 180 degrees about its vertical axis"),
    (_FLIP, "its pose is in other axes, unlike the other cameras: negate its y and z axes"),
)
# Every exchange of poses is compared with all matches, so their number is limited.
_MAX_EXCHANGED = 12
# Factors of the focal length that are tried, and their step: at a wrong focal length the error has
# several minima.
_FACTOR_OCTAVES = 2.0
_FACTOR_STEP = 0.25
# Factors nearer to 1 than this are no mistake in the calibration's image size or field of view.
_LEAST_FACTOR = 0.1


def duplicate_poses(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Return the pairs of cameras with the same pose."""
    positions = positions_of(cameras)
    rotations = np.array([camera.rotation for camera in cameras])
    near = _SAME * central_distances(positions).max()
    same = np.linalg.norm(positions[:, None] - positions, axis=-1) <= near
    same &= np.abs(rotations[:, None] - rotations).max(axis=(2, 3)) < _SAME
    return [(i, j) for i, j in np.argwhere(np.triu(same, 1)).tolist()]


def rig_candidates(
    cameras: Sequence[Camera], layout: str
) -> Iterator[tuple[Sequence[Camera], str]]:
    """Yield the corrected cameras of a layout for each mistake that concerns several poses."""
    if layout == poses_bounds.READER.name:
        names = [camera.name for camera in cameras]
        alphabetical = sorted(names)
        order = ", ".join(alphabetical[:4])
        yield (
            [cameras[alphabetical.index(name)] for name in names],
            f"the rows seem to be in alphabetical order ({order}, ...); put them in numerical "
            "order",
        )
        yield (
            _turned(cameras, _UPRIGHT),
            "the columns seem to be the camera's right, up and backward axes; expected down, "
            "right, backward",
        )
    else:
        conventions = {reader.name: reader.poses for reader in reader_registry.READERS}
        poses = conventions.get(layout, PoseConvention())
        if poses:
            # Images do not determine a rotation of the world, so there are only four
            # distinguishable conventions of 4x4 matrices.
            inverses = [replace(c, viewmat=np.linalg.inv(c.viewmat)) for c in cameras]
            forth = poses.direction
            back = "world to camera" if forth == "camera to world" else "camera to world"
            remedy = f"expected {forth} in {_AXES[poses.axes]}; convert them"
            for rig, direction, axes in (
                (_turned(cameras, _FLIP), forth, "OpenCV" if poses.axes == "OpenGL" else "OpenGL"),
                (inverses, back, "OpenCV"),
                (_turned(inverses, _FLIP), back, "OpenGL"),
            ):
                yield rig, f"the poses seem to be {direction} in {_AXES[axes]}; {remedy}"
    if len(cameras) <= _MAX_EXCHANGED:
        for i, j in combinations(range(len(cameras)), 2):
            rig = [*cameras]
            rig[i] = cameras[j]
            rig[j] = cameras[i]
            names = f"{cameras[i].name} and {cameras[j].name}"
            yield rig, f"the clips of {names}, or their poses, seem to be swapped; exchange them"


def camera_candidates(camera: Camera) -> Iterator[tuple[Camera, str]]:
    """Yield the corrected camera for each mistake that concerns a single pose."""
    pose = camera.world_to_camera
    for rotation, sentence in _CAMERA_MISTAKES:
        yield replace(camera, viewmat=rotation @ pose), sentence
    # A turned pose keeps the principal point; a turned image has the opposite one.
    opposite = (camera.width, camera.height, 2) - camera.K[:, 2]
    K = np.column_stack([camera.K[:, :2], opposite])
    yield replace(camera, viewmat=_HALF_TURN @ pose, K=K), _UPSIDE_DOWN
    yield (
        replace(camera, viewmat=np.linalg.inv(pose)),
        "its pose is inverted, the other poses are not: invert it",
    )


def focal_candidates(
    what: str, scaled: Callable[[float], T], error: Callable[[T], float]
) -> list[tuple[T, str]]:
    """Return what a factor from 1/4 to 4 on focal lengths corrects, if the best factor differs from
    1.

    Args:
        what: start of the sentence on the mistake.
        scaled: returns what has a factor on its focal lengths.
        error: error of what is scaled, px.
    """

    def error_of(octaves: float) -> float:
        # The search cannot compare infinite errors.
        return min(error(scaled(float(2.0**octaves))), 1e9)

    steps = np.arange(-_FACTOR_OCTAVES, _FACTOR_OCTAVES + _FACTOR_STEP, _FACTOR_STEP)
    start = min(steps, key=error_of)
    bounds = (start - _FACTOR_STEP, start + _FACTOR_STEP)
    # Imported here because it slows down the start of every command.
    from scipy.optimize import minimize_scalar

    minimum: Any = minimize_scalar(
        error_of, bounds=bounds, method="bounded", options={"xatol": 3e-3}
    )
    factor = float(2.0**minimum.x)
    if abs(factor - 1) <= _LEAST_FACTOR:
        return []
    sentence = (
        f"{what} to be wrong by a factor, {factor:.2g} times the given value fits: check the "
        "image size of the calibration, and whether its field of view is horizontal or vertical"
    )
    return [(scaled(factor), sentence)]


def with_focal_factor(camera: Camera, factor: float) -> Camera:
    """Return the camera with its focal lengths multiplied by `factor`."""
    return replace(camera, K=camera.K @ np.diag([factor, factor, 1.0]))


def _turned(cameras: Sequence[Camera], rotation: np.ndarray) -> list[Camera]:
    """Return the cameras with a rotation [4, 4] of their axes."""
    return [replace(camera, viewmat=rotation @ camera.viewmat) for camera in cameras]
