"""Lens distortion of COLMAP's camera models, undone once per camera by OpenCV's maps.

Notation: a model's parameters are its focal length(s), principal point and distortion coefficients, in
COLMAP's order. OpenCV puts pixel centres at integers, COLMAP and `Camera` at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.core.camera import Camera

__all__ = ["Lens", "Undistortion", "lens_and_intrinsics", "undistortion"]

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
    """What bends the rays of a COLMAP camera.

    Attributes:
        model: COLMAP's name of the model, e.g. ``OPENCV``.
        distortion: its coefficients in COLMAP's order; empty for a pinhole.
    """

    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()

    @property
    def opencv_coefficients(self) -> np.ndarray:
        """The coefficients as OpenCV takes them: [4] for a fisheye, else [8] (k1 k2 p1 p2 k3 .. k6)."""
        count = 4 if self.model == "OPENCV_FISHEYE" else 8
        return np.pad(np.array(self.distortion, dtype=np.float64), (0, count - len(self.distortion)))


def lens_and_intrinsics(model: str, params: Sequence[float]) -> tuple[Lens, np.ndarray]:
    """Split a COLMAP camera's parameters into its lens and K [3, 3].

    Raises:
        ValueError: the model is not supported, or the number of parameters is not the model's.
    """
    if model not in MODELS:
        raise ValueError(
            f"the camera model must be one of {', '.join(MODELS)}, got {model}; "
            "undistort the images with COLMAP's image_undistorter first."
        )
    focals, coefficients = MODELS[model]
    if len(params) != focals + 2 + coefficients:
        raise ValueError(
            f"the camera model {model} takes {focals + 2 + coefficients} parameters, "
            f"got {len(params)}; write the model again."
        )
    fx, fy, (cx, cy) = params[0], params[focals - 1], params[focals : focals + 2]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
    return Lens(model, tuple(map(float, params[focals + 2 :]))), K


@dataclass(frozen=True)
class Undistortion:
    """The pixel maps that undo one lens, and what they reach.

    Attributes:
        maps: OpenCV's fixed-point maps for `cv2.remap`.
        mask: [H, W] bool, true where the undistorted pixel lies inside the recorded image, and the lens model holds.
    """

    maps: tuple[np.ndarray, np.ndarray]
    mask: np.ndarray

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the image [H, W, 3] as the pinhole camera with the same K would have seen it."""
        # Cubic, for linear filtering blurs by the sub-pixel shifts that most of these lenses cause.
        return cv2.remap(image, *self.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def undistortion(camera: Camera, lens: Lens) -> Undistortion | None:
    """Return what undoes `lens`, or None where there is nothing to undo.

    The undistorted view has the same K and size as the recorded one, so corners of a barrel-shaped
    image are lost and those of a pincushion-shaped one are empty (see `Undistortion.mask`).
    """
    if not any(lens.distortion):
        return None
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    size = (camera.width, camera.height)
    fisheye = lens.model == "OPENCV_FISHEYE"
    build = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    x, y = build(K, lens.opencv_coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    mask = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
    mask &= ~_folded(x, y, K)
    # Fixed point halves the memory of a rig's maps; its 1/32 px is far below any calibration's error.
    return Undistortion(cv2.convertMaps(x, y, cv2.CV_16SC2), mask)


def _folded(x: np.ndarray, y: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return where a lens model is beyond the angle up to which it holds [H, W].

    A polynomial that was fitted to the recorded rays turns back farther out, and would show the image's inside there
    once more, mirrored.
    """
    # Every few pixels is enough, and quick.
    step = max(1, min(x.shape) // 256)
    coarse = x[::step, ::step], y[::step, ::step]
    if min(coarse[0].shape) < 2:
        return np.zeros(x.shape, bool)
    (x_down, x_right), (y_down, y_right) = (np.gradient(values) for values in coarse)
    rows, columns = np.ogrid[: x.shape[0], : x.shape[1]]
    radius = np.hypot((columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1])
    turned = x_right * y_down - x_down * y_right <= 0
    return radius >= np.min(radius[::step, ::step][turned], initial=np.inf)
