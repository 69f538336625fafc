"""Geometry of a rig: its extent, what its cameras look at, and the angles and overlaps between
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from morgs_mi.core.camera import Camera, unit_vectors
from morgs_mi.platform.checks import require, view_index

# Rows and columns of the points of each view.
_GRID = 16
# Depth of a near plane relative to what a camera sees. A subject may come this much closer than the
# scene's points, and what is nearer than that is a splat that hides another camera's lens (see
# `docs/experiments/real.md`).
_NEAR_SHARE = 0.2
# One per cent of the points may be wrong matches. A view with fewer points has no reliable depth.
_RELIABLE_QUANTILE = 0.01
_RELIABLE_POINTS = 20
# Before the near planes are known, every point in front of a camera counts.
_IN_FRONT = 1e-30
# Sizes of a rig from the origin beyond which float32 costs hundredths of a pixel.
_FAR = 100


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Return the scene extent in world units: 1.1 times the radius of the cameras around their
    mean, as in 3DGS.

    It is 1 for a single camera.
    """
    radius = central_distances(positions_of(cameras)).max()
    return float(1.1 * radius) if radius > 0 else 1.0


def positions_of(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the positions of the cameras [V, 3]."""
    return np.array([camera.position for camera in cameras])


def central_distances(positions: np.ndarray) -> np.ndarray:
    """Return the distance of each of the positions [V, 3] from their mean [V]."""
    return np.linalg.norm(positions - positions.mean(0), axis=1)


def far_origin(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the median position [3] of cameras that are too far from 0 for float32, rounded to the
    power of ten below ten times their mean distance from it; zeros if they are not.
    """
    positions = positions_of(cameras)
    middle = np.median(positions, axis=0)
    distance = np.linalg.norm(middle)
    size = max(np.linalg.norm(positions - middle, axis=1).mean() or 1.0, 1e-9 * distance)
    far = distance > _FAR * size
    return np.round(middle, -int(np.floor(np.log10(10 * size)))) if far else np.zeros(3)


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the mean up direction of the cameras [3], of unit length; the first camera's where
    they cancel out.
    """
    ups = np.stack([-camera.rotation[1] for camera in cameras])
    mean = ups.mean(axis=0)
    up = mean if np.linalg.norm(mean) > 0.1 else ups[0]
    return unit_vectors(up)


def focus_point(
    cameras: Sequence[Camera], center: np.ndarray | None = None, weight: float = 1e-9
) -> np.ndarray:
    """Return the point [3] that is nearest to all optical axes in the least-squares sense.

    Along a direction that all axes share, it lies at `center`, by default the mean camera position,
    which has a weight relative to one axis.
    """
    middle = positions_of(cameras).mean(0) if center is None else center
    system = weight * np.eye(3)
    right = np.zeros(3)
    for camera in cameras:
        axis = camera.rotation[2]
        across = np.eye(3) - np.outer(axis, axis)
        system = system + across
        right = right + across @ (camera.position - middle)
    return middle + np.linalg.solve(system, right)


@dataclass(frozen=True, eq=False)
class Focus:
    """The `focus_point` of a rig."""

    point: np.ndarray  #: [3], world units.
    extent: float  #: `scene_extent` of the cameras.

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Focus:
        """Return the focus of some cameras."""
        return cls(focus_point(cameras), scene_extent(cameras))

    def depth(self, camera: Camera) -> float:
        """Return its depth in a view, world units; infinity if it is not in front."""
        depth = float(camera.world_to_camera[2] @ np.append(self.point, 1))
        return depth if depth > 1e-3 * self.extent else np.inf


@dataclass(frozen=True, eq=False)
class ScenePlane:
    """The plane across a view at the depth of the scene, which stands for the scene there."""

    camera: Camera  #: The view.
    depth: float  #: World units.

    @classmethod
    def of(cls, camera: Camera, points: np.ndarray, focus: Focus) -> ScenePlane:
        """Return the plane at the median depth of the points [P, 3] in a view.

        Without points in the view, it is at the depth of the focus, or at 1e6 scene extents if that
        is not in front.
        """
        far = 1e6 * focus.extent
        _, _, depths = seen_points(camera, points)
        depth = float(np.median(depths)) if len(depths) else min(focus.depth(camera), far)
        return cls(camera, depth if depth > camera.near else far)

    @cached_property
    def points(self) -> np.ndarray:
        """Points [P, 3] that are evenly spread over the image."""
        steps = (np.arange(_GRID) + 0.5) / _GRID
        grid = np.meshgrid(steps * self.camera.width, steps * self.camera.height)
        pixels = np.stack(grid, axis=-1).reshape(-1, 2)
        return self.camera.unproject(pixels, np.full(len(pixels), self.depth))

    def angles_to(self, others: Sequence[Camera]) -> np.ndarray:
        """Return the angles from its camera to other cameras, as seen from the point in the middle
        of the image, degrees.
        """
        center = np.array([[self.camera.width / 2, self.camera.height / 2]])
        middle = self.camera.unproject(center, np.array([self.depth]))
        return np.array([angles_between(middle, self.camera, other)[0] for other in others])


def seen_points(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points [P, 3] lie in a view [P], the n pixel positions [n, 2] of those, and
    their depths [n].
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # points beside the camera
        pixels, depths = camera.project(np.asarray(points, np.float64).reshape(-1, 3))
    visible = (depths > camera.near) & in_image(camera, pixels)
    return visible, pixels[visible], depths[visible]


def in_image(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the mask [...] of the pixel positions [..., 2] that lie in the image of a camera."""
    return np.all((pixels >= 0) & (pixels < camera.size), axis=-1)


def with_near_planes(
    cameras: Sequence[Camera], points: np.ndarray, near: float | None = None
) -> tuple[Camera, ...]:
    """Return the cameras with near planes that follow the scene.

    The plane of a camera has a fifth of the smallest reliable depth of the points in its view,
    which is their first percentile. A camera that sees fewer than 20 points has a fifth of the
    depth of the `focus_point`, or of the scene extent if that is smaller. If the `focus_point` is
    not in front of it, it has a fifth of the distance to the nearest other camera.

    Args:
        cameras: the rig. A camera that no rule applies to, such as a single one without points,
            keeps its near plane.
        points: [P, 3] of the scene, world units, or none.
        near: depth of all near planes instead, world units.

    Raises:
        ValueError: `near` is not positive, or there are no cameras.
    """
    require(cameras, "with_near_planes()", "`cameras` must be at least one", "none", "pass a rig")
    if near is not None:
        return tuple(replace(camera, near=near) for camera in cameras)
    positions = positions_of(cameras)
    focus = Focus.of(cameras)
    result = []
    for camera in cameras:
        _, _, depths = seen_points(replace(camera, near=_IN_FRONT), points)
        if len(depths) >= _RELIABLE_POINTS:
            depth = float(np.quantile(depths, _RELIABLE_QUANTILE))
        else:
            depth = _rig_depth(camera, focus, positions)
        result.append(replace(camera, near=_NEAR_SHARE * depth) if depth > 0 else camera)
    return tuple(result)


def check_near_planes(where: str, cameras: Sequence[Camera], points: np.ndarray) -> None:
    """Check that not all near planes are behind the scene, which then would not be rendered.

    Raises:
        ValueError: they are, in a sentence that begins with `where`.
    """
    focus = Focus.of(cameras)

    def depth_of(camera: Camera) -> float:
        return ScenePlane.of(replace(camera, near=_IN_FRONT), points, focus).depth

    require(
        any(camera.near <= depth_of(camera) for camera in cameras),
        where,
        "the near planes of `cameras` must be in front of the scene",
        f"{cameras[0].near:g} world units where it is {depth_of(cameras[0]):.3g} away",
        "pass with_near_planes(cameras, points), or cameras with a smaller `near`",
    )


def _rig_depth(camera: Camera, focus: Focus, positions: np.ndarray) -> float:
    """Return a depth within which a camera shares nothing with the others, by the focus and the
    positions [V, 3] of the rig alone; 0 if unknown.
    """
    depth = min(focus.depth(camera), focus.extent)
    if np.isinf(focus.depth(camera)):
        # The least distance is the camera's own.
        distances = np.sort(np.linalg.norm(positions - camera.position, axis=1))[1:]
        depth = float(distances.min(initial=np.inf))
    # Cameras at one place are apart by rounding errors.
    rounding = 1e-9 * np.abs(positions).max()
    return depth if rounding < depth < np.inf else 0.0


def choose_key_views(
    cameras: Sequence[Camera], selection: int | tuple[str, ...]
) -> tuple[int, ...]:
    """Return the indices of the views with these names, or of this number of views spread over the
    rig, or of all if there are fewer.

    Of a number, the first is the most central one; each further one is the farthest from the
    earlier ones.

    Raises:
        ValueError: no view has a name.
    """
    if isinstance(selection, tuple):
        names = [camera.name for camera in cameras]
        place = "StreamLoop()"
        views = (view_index(place, "`motion.key_views`", name, names) for name in selection)
        return tuple(sorted({*views}))
    if not cameras:
        return ()
    positions = positions_of(cameras)
    views = [int(np.argmin(central_distances(positions)))]
    while len(views) < min(selection, len(cameras)):
        distance = np.linalg.norm(positions[:, None] - positions[views], axis=-1).min(1)
        views.append(int(np.argmax(distance)))
    return tuple(sorted(views))


def mean_views(cameras: Sequence[Camera], points: np.ndarray) -> float:
    """Return the mean number of views that see a surface of the scene, by their frustums; at least
    1.

    Args:
        cameras: at least one.
        points: [P, 3] of the scene, world units, or none.
    """
    return max(1.0, float(overlaps(cameras, points).sum(axis=1).mean()))


def overlaps(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return the share of each camera's image that each camera sees, by their frustums [C, C].

    Args:
        cameras: C views.
        points: [P, 3] of the scene, world units, or none.
    """
    planes = scene_planes(cameras, points)
    return np.array(
        [[np.mean(seen_points(other, plane.points)[0]) for other in cameras] for plane in planes]
    )


def scene_planes(cameras: Sequence[Camera], points: np.ndarray) -> list[ScenePlane]:
    """Return the plane that stands for the scene in each view.

    Args:
        cameras: the rig.
        points: [P, 3] of the scene, world units, or none.
    """
    focus = Focus.of(cameras)
    return [ScenePlane.of(camera, points, focus) for camera in cameras]


def angles_between(points: np.ndarray, a: Camera, b: Camera) -> np.ndarray:
    """Return the angle between two cameras as seen from each point, degrees."""
    rays = [camera.position - points for camera in (a, b)]
    x, y = map(unit_vectors, rays)
    return np.rad2deg(np.arccos(np.clip((x * y).sum(axis=1), -1, 1)))
