"""Dense points from pairs of neighbouring cameras that are close enough for stereo matching.

A pair is rectified, which puts a point into the same row of both images, and matched by OpenCV's
semi-global block matching. A point is returned if both directions of matching agree and a third
camera that sees it shows its colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import ScenePlane, scene_planes, seen_points
from morgs_mi.core.view import View
from morgs_mi.fit.features import reduced_size
from morgs_mi.fit.view import SAME_POINT, seen_pixels
from morgs_mi.platform.checks import valid_pixels

# Images are reduced to this number of pixels: the points only initialise a fit, which is more
# exact.
_PIXELS = 2e5
# Number of nearest cameras that each is matched with: farther ones see little else.
_NEIGHBOURS = 2
# Least and largest angle between two cameras, degrees: depths are uncertain, or patches unlike.
_MIN_ANGLE = 0.5
_MAX_ANGLE = 25.0
# Largest number of points of a pair: a first frame starts from some ten thousand.
_POINTS = 4000
# Range of searched depths, as fractions of the near and far end of the known points.
_NEAR = 0.6
_FAR = 1.6
# Least number of known points that have such ends.
_KNOWN = 10
# With fewer, largest ratio of a searched depth and the one that the cameras look at.
_BLIND = 3.0
# Largest difference between the disparities of both directions, px.
_MAX_DIFFERENCE = 1.0
# Side of the blocks that are compared, px.
_BLOCK = 5
# Least depth of a view's corners in the rectified view, for depth 1 in the camera: less is too
# oblique.
_LEAST_DEPTH = 0.2


def stereo_points(
    views: Sequence[View],
    scene_points: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P, 3], world units, and their colours [P, 3] in [0, 1]; none if no cameras are
    close.

    Args:
        views: views with images of uint8.
        scene_points: points [K, 3] of the scene, which limit the depths.
        rng: random generator for the selection of points.
    """
    cameras = [view.camera for view in views]
    reduced = [_Reduced.of(view) for view in views]
    batches = [np.zeros((0, 6), np.float32)]
    planes = scene_planes(cameras, scene_points)
    pairs = set()  # of cameras that are close enough
    for i, plane in enumerate(planes):
        angles = plane.angles_to(cameras)
        angles[i] = np.inf
        for j in np.argsort(angles)[:_NEIGHBOURS].tolist():
            if _MIN_ANGLE <= angles[j] <= _MAX_ANGLE:
                pairs.add((min(i, j), max(i, j)))
    for i, j in sorted(pairs):
        points = _matched(reduced[i], reduced[j], _depth_range(planes[i], scene_points))
        others = [view for k, view in enumerate(reduced) if k not in (i, j)]
        points = _some_confirmed(rng.permutation(points), others)
        batches.append(points.astype(np.float32))
    points, colors = np.split(np.concatenate(batches), 2, axis=1)
    return points, colors


@dataclass(frozen=True)
class _Reduced:
    """A view, reduced."""

    camera: Camera  # camera of the image's size
    image: np.ndarray  # uint8 [H, W, 3]
    blurred: np.ndarray  # the image, averaged over 3 x 3 pixels
    valid: np.ndarray  # uint8 [H, W], 255 where the pixel is valid

    @classmethod
    def of(cls, view: View) -> _Reduced:
        """Return the reduced view."""
        size = reduced_size(*view.camera.size, _PIXELS)
        mask = valid_pixels(view.mask, view.image.shape)
        valid = cv2.resize(255 * mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        image = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
        return cls(view.camera.resized(*size), image, cv2.blur(image, (3, 3)), valid)


def _depth_range(plane: ScenePlane, scene_points: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest depth in a view, around its plane if few are known."""
    _, _, depths = seen_points(plane.camera, scene_points)
    if len(depths) >= _KNOWN:
        near, far = np.quantile(depths, (0.02, 0.98))
        return _NEAR * float(near), _FAR * float(far)
    return plane.depth / _BLIND, plane.depth * _BLIND


@dataclass(frozen=True)
class _Rectified:
    """Two views on one plane along the line between their cameras."""

    axes: np.ndarray  # axes of the plane, rows right, down and forward in the world [3, 3]
    focal: float  # focal length, px
    baseline: float  # distance of the cameras, world units
    left: _RectifiedView  # the first view
    right: _RectifiedView  # the second view
    top: float  # position of their first rows relative to the optical axes, px
    size: tuple[int, int]  # width and height of both images

    @classmethod
    def of(cls, a: Camera, b: Camera) -> _Rectified | None:
        """Return the rectification of two views, None if no plane shows both, e.g. with one camera
        behind the other.
        """
        right = b.position - a.position
        baseline = float(np.linalg.norm(right))
        right = right / baseline
        forward = a.viewmat[2, :3] + b.viewmat[2, :3]
        forward = forward - forward @ right * right
        forward /= max(float(np.linalg.norm(forward)), 1e-12)
        axes = np.stack([right, np.cross(forward, right), forward])
        focal = float(a.K[0, 0] + b.K[0, 0]) / 2
        plane = np.diag([focal, focal, 1]) @ axes
        to_plane_a = plane @ a.viewmat[:3, :3].T @ np.linalg.inv(a.K)
        to_plane_b = plane @ b.viewmat[:3, :3].T @ np.linalg.inv(b.K)
        corners_a = _corners(a) @ to_plane_a.T
        corners_b = _corners(b) @ to_plane_b.T
        if min(corners_a[:, 2].min(), corners_b[:, 2].min()) < _LEAST_DEPTH:
            return None
        ax, ay = (corners_a[:, :2] / corners_a[:, 2:]).T
        bx, by = (corners_b[:, :2] / corners_b[:, 2:]).T
        # The images have the rows that both views have.
        top = max(ay.min(), by.min())
        width = max(np.ptp(ax), np.ptp(bx))
        size = int(np.ceil(width)), int(np.ceil(min(ay.max(), by.max()) - top))
        left = _RectifiedView.of(to_plane_a, ax.min(), top)
        right = _RectifiedView.of(to_plane_b, bx.min(), top)
        return cls(axes, focal, baseline, left, right, top, size)


@dataclass(frozen=True)
class _RectifiedView:
    """Mapping of a view to its rectified image."""

    # from its pixels to those of the rectified image, for OpenCV, whose pixel centres lie at whole
    # numbers [3, 3]
    homography: np.ndarray
    start: float  # position of the image's first column relative to the optical axis, px

    @classmethod
    def of(cls, to_plane: np.ndarray, start: float, top: float) -> _RectifiedView:
        """Return the mapping to an image that begins at a place of the plane, px."""
        homography = _shift(-0.5, -0.5) @ (_shift(-start, -top) @ to_plane) @ _shift(0.5, 0.5)
        return cls(homography, start)

    def image(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Return the rectified image of a view's image, of some width and height."""
        return cv2.warpPerspective(image, self.homography, size)

    def mask(self, mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Return the rectified mask of a view's mask, uint8, of some width and height."""
        return cv2.warpPerspective(mask, self.homography, size, flags=cv2.INTER_NEAREST) > 0


def _corners(camera: Camera) -> np.ndarray:
    """Return the corners of the image of a camera, in homogeneous pixels [4, 3]."""
    w, h = camera.size
    return np.array([[0, 0, 1], [0, h, 1], [w, 0, 1], [w, h, 1]])


def _matched(a: _Reduced, b: _Reduced, depths: tuple[float, float]) -> np.ndarray:
    """Return the points of a pair of views and their colours [P, 6], at depths in a range."""
    none = np.zeros((0, 6))
    rig = _Rectified.of(a.camera, b.camera)
    if rig is None:
        return none
    # The lowest disparity, and the number of disparities, of these depths.
    product = rig.focal * rig.baseline
    shift = rig.right.start - rig.left.start  # disparity of infinitely distant points, px
    lowest = int(np.floor(product / depths[1] + shift))
    steps = product / depths[0] + shift - lowest + 1
    count = 16 * max(1, int(np.ceil(steps / 16)))
    # Strongly converging cameras have no useful plane in common.
    width, height = rig.size
    if min(rig.size) < 2 * _BLOCK or count > width or width * height > 4 * a.valid.size:
        return none
    left = rig.left.image(a.image, rig.size)
    right = rig.right.image(b.image, rig.size)
    forth = _disparity(left, right, lowest, count)
    back = _disparity(right, left, 1 - lowest - count, count)
    left_valid = rig.left.mask(a.valid, rig.size)
    right_valid = rig.right.mask(b.valid, rig.size)
    # The pixels with a partner in the other image, which is valid and has them as its partner.
    rows, columns = np.nonzero(left_valid & (forth >= lowest) & (forth - shift > 0))
    disparity = forth[rows, columns]
    partner = np.round(columns - disparity).astype(int)
    place = np.clip(partner, 0, width - 1)
    agree = np.abs(disparity + back[rows, place]) <= _MAX_DIFFERENCE
    good = agree & (partner == place) & right_valid[rows, place]
    rows = rows[good]
    columns = columns[good]
    depth = product / (disparity[good] - shift)
    x = (columns + 0.5 + rig.left.start) * depth / rig.focal
    y = (rows + 0.5 + rig.top) * depth / rig.focal
    points = np.stack([x, y, depth], axis=1) @ rig.axes + a.camera.position
    return np.concatenate([points, left[rows, columns] / 255.0], axis=1)


def _disparity(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> np.ndarray:
    """Return the disparity of each pixel of the left image [H, W], px, below `lowest` where there
    is none.
    """
    # OpenCV leaves out the columns with partners that may lie outside the image.
    left_pad = max(lowest + count, 0) + _BLOCK
    right_pad = max(-lowest, 0) + _BLOCK
    wide = [
        cv2.copyMakeBorder(image, 0, 0, left_pad, right_pad, cv2.BORDER_CONSTANT)
        for image in (left, right)
    ]
    area = 3 * _BLOCK**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * area,
        P2=32 * area,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    return matcher.compute(*wide)[:, left_pad:-right_pad] / 16.0


def _some_confirmed(points: np.ndarray, others: Sequence[_Reduced]) -> np.ndarray:
    """Return the first points [at most `_POINTS`, 6] that other views confirm; all count if there
    are none.
    """
    if not others:
        return points[:_POINTS]
    confirmed = points[:0]
    for start in range(0, len(points), _POINTS):
        if len(confirmed) < _POINTS:
            part = points[start : start + _POINTS]
            # Points that have their colour in a valid pixel of another view.
            good = np.zeros(len(part), bool)
            for view in others:
                visible, pixels = seen_pixels(view.camera, part[:, :3])
                errors = np.abs(view.blurred[pixels] / 255.0 - part[visible, 3:])
                good[visible] |= (view.valid[pixels] > 0) & (errors.max(axis=1) < SAME_POINT)
            confirmed = np.concatenate([confirmed, part[good]])
    return confirmed[:_POINTS]


def _shift(x: float, y: float) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])
