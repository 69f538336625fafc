"""Undistortion of COLMAP's camera models by OpenCV's pixel maps, computed once per camera.

Notation: a model's parameters are its focal length(s), principal point and distortion coefficients,
in COLMAP's order. OpenCV puts pixel centres at integers, COLMAP and `Camera` at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.platform.checks import LARGEST, bounded

# Per COLMAP model, in the order of its binary ids: the number of focal lengths and of coefficients.
MODELS = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "OPENCV_FISHEYE": (2, 4),
    "FULL_OPENCV": (2, 8),
}


@dataclass(frozen=True)
class Lens:
    """Lens distortion of a COLMAP camera."""

    model: str = "PINHOLE"  #: COLMAP's name of the model, e.g. ``OPENCV``.
    #: Distortion coefficients in COLMAP's order; empty for a pinhole.
    distortion: tuple[float, ...] = ()

    @property
    def opencv_coefficients(self) -> np.ndarray:
        """The coefficients in OpenCV's order: [4] for a fisheye, otherwise [8] (k1 k2 p1 p2 k3 ..
        k6).
        """
        count = 4 if self.model == "OPENCV_FISHEYE" else 8
        return np.pad(
            np.array(self.distortion, dtype=np.float64), (0, count - len(self.distortion))
        )


def lens_and_intrinsics(model: str, params: Sequence[float]) -> tuple[Lens, np.ndarray]:
    """Split a COLMAP camera's parameters into the lens and K [3, 3].

    Raises:
        ValueError: the model is not supported, or the parameters are not finite or do not match
            its number of them.
    """
    if model not in MODELS:
        raise ValueError(
            f"the camera model must be one of {', '.join(MODELS)}, got {model}; undistort the "
            "images with COLMAP's image_undistorter."
        )
    focals, coefficients = MODELS[model]
    count = 2 + focals + coefficients
    if len(params) != count or not bounded(params):
        raise ValueError(
            f"the camera model {model} takes {count} parameters of at most {LARGEST:g}, got "
            f"{len(params)}: {[*params][:count]}; calibrate again."
        )
    K = np.eye(3)
    K[[0, 1], [0, 1]] = params[:focals]
    K[:2, 2] = params[focals : focals + 2]
    return Lens(model, tuple(map(float, params[focals + 2 :]))), K


def opencv_lens(coefficients: Sequence[float]) -> Lens:
    """Return the lens with OpenCV's coefficients k1 k2 p1 p2, or k1 k2 p1 p2 k3, or k1 k2 p1 p2 k3
    k4 k5 k6.
    """
    values = tuple(map(float, coefficients))
    if any(values[4:]):
        return Lens("FULL_OPENCV", values + (0.0,) * (8 - len(values)))
    return Lens("OPENCV", values[:4])


def undistorted(camera: Camera, lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Return the pixels [P, 2] of the pinhole `camera` that `lens`, which is no fisheye, shows at
    `pixels` [P, 2].
    """
    if not any(lens.distortion) or not len(pixels):
        return pixels
    precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    points = np.ascontiguousarray(pixels[:, None], np.float64)
    return cv2.undistortPoints(
        points, camera.K, lens.opencv_coefficients, None, np.eye(3), camera.K, precise
    )[:, 0]


@dataclass(frozen=True)
class Undistortion:
    """Pixel maps that remove the distortion of one lens."""

    maps: tuple[np.ndarray, np.ndarray]  #: OpenCV's fixed-point maps for `cv2.remap`.
    #: [H, W] bool, true where the undistorted pixel lies inside the recorded image and the lens
    #: model is valid.
    mask: np.ndarray

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the image [H, W, 3] of the pinhole camera with the same K."""
        # Cubic, because linear filtering would blur: most of these lenses shift pixels by fractions
        # of a pixel.
        return cv2.remap(image, *self.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def undistortion(
    camera: Camera, lens: Lens, refined: tuple[Camera, Lens] | None = None
) -> Undistortion | None:
    """Return the undistortion of `lens`, or None for a lens without distortion.

    The undistorted view has the same K and size as the recorded one, so a barrel-shaped image loses
    its corners and a pincushion-shaped one has empty corners (see `Undistortion.mask`).

    Args:
        camera: at the size of the recorded images.
        lens: lens of the camera.
        refined: intrinsics of the view instead of the camera's, and the distortion that `lens`
            leaves in its images.
    """
    stages = [stage for stage in ((camera, lens), refined) if stage and any(stage[1].distortion)]
    if not stages:
        return None
    x, y, mask = _maps(*stages[0])
    for stage in stages[1:]:
        columns, rows, valid = _maps(*stage)
        x, y = (
            cv2.remap(v, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for v in (x, y)
        )
        recorded = cv2.remap(mask.astype(np.float32), columns, rows, cv2.INTER_LINEAR)
        mask = valid & (recorded > 1 - 1e-3)
    # Fixed point halves the memory of a rig's maps; its 1/32 px is far below the error of any
    # calibration.
    return Undistortion(cv2.convertMaps(x, y, cv2.CV_16SC2), mask)


def _maps(camera: Camera, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the columns and rows [H, W] px at which a lens shows a pinhole camera's pixels, and
    the mask of valid ones.
    """
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    size = camera.size
    fisheye = lens.model == "OPENCV_FISHEYE"
    build = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    x, y = build(K, lens.opencv_coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    mask = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
    # A polynomial that was fitted to the recorded rays decreases again farther out, where it would
    # mirror the inner part of the image. Sampling every few pixels is accurate enough, and fast.
    step = max(1, min(x.shape) // 256)
    (x_down, x_right), (y_down, y_right) = (np.gradient(v[::step, ::step]) for v in (x, y))
    fold = x_right * y_down - x_down * y_right <= 0
    # Distance from the optical axis at depth 1.
    across = (np.arange(camera.width) - K[0, 2]) / K[0, 0]
    down = (np.arange(camera.height) - K[1, 2]) / K[1, 1]
    radius = np.hypot(across, down[:, None])
    return x, y, mask & (radius < np.min(radius[::step, ::step][fold], initial=np.inf))
