"""Common mistakes in several poses of a calibration, and the cameras that would correct them.

A candidate is a pair of corrected cameras and the description of the mistake. The rig check accepts
a candidate that explains the matches between the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from morgs_mi.capture.layouts import poses_bounds, reader_registry
from morgs_mi.capture.layouts.calibration import PoseConvention
from morgs_mi.core.camera import Camera

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Corrects columns right, up of a camera that were read as down, right.
_UPRIGHT = np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_AXES = {
    "OpenCV": "OpenCV's axes (x right, y down, z forward)",
    "OpenGL": "OpenGL's axes (x right, y up, z backward)",
}
# Every exchange of poses is compared with all matches, so their number is limited.
_MAX_EXCHANGED = 12
# Factors of the focal length that are tried, and their step: at a wrong focal length the error has
# several minima.
_FACTOR_OCTAVES = 2.0
_FACTOR_STEP = 0.25
# Factors nearer to 1 than this are no mistake in the calibration's image size or field of view.
_LEAST_FACTOR = 0.1


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


def focal_candidates(
    cameras: Sequence[Camera], error: Callable[[Sequence[Camera]], float]
) -> list[tuple[Sequence[Camera], str]]:
    """Return the cameras with a factor from 1/4 to 4 on all focal lengths, if the best factor
    differs from 1.

    Args:
        cameras: the rig.
        error: error of a rig, px.
    """

    def scaled(octaves: float) -> list[Camera]:
        factors = np.diag([2.0**octaves, 2.0**octaves, 1.0])
        return [replace(camera, K=camera.K @ factors) for camera in cameras]

    def error_of(octaves: float) -> float:
        # The search cannot compare infinite errors.
        return min(error(scaled(octaves)), 1e9)

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
        f"the focal lengths of all cameras seem to be wrong by a factor, {factor:.2g} times the "
        "given value fits: check the image size of the calibration, and whether its field of view "
        "is horizontal or vertical"
    )
    return [(scaled(minimum.x), sentence)]


def _turned(cameras: Sequence[Camera], rotation: np.ndarray) -> list[Camera]:
    """Return the cameras with a rotation [4, 4] of their axes."""
    return [replace(camera, viewmat=rotation @ camera.viewmat) for camera in cameras]
