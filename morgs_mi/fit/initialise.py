"""The initial Gaussians: on SfM points, on random points inside the views, or on both.

The problem of the first frame: the views of one timestamp, and the Gaussians that a fit to them
starts from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0, unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import Focus, in_image, scene_extent, scene_planes, seen_points
from morgs_mi.core.view import View
from morgs_mi.fit.far_views import PointCloud, are_around, far_points
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import (
    SAME_POINT,
    random_pixels,
    seen_pixels,
    shares_of,
    shown_colors,
)
from morgs_mi.platform.checks import valid_pixels
from morgs_mi.render.render_config import RenderConfig

RGB = tuple[float, float, float]
"""A colour, encoded: 1 is white."""
NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))
MIN_POINTS = 20
"""Number of points below which Gaussians start from random ones."""
MANY_POINTS = 1000
"""Number of points below which random ones are added where views show none."""
# Share of the points that the cameras see, at least, and the number of points that are checked.
_LEAST_SEEN = 0.05
_CHECKED = 10_000
# Rows and columns into which a view is divided to find where it shows no points.
_CELLS = 8
# Random depths of a random point, of which one is chosen.
_DEPTHS = 64
# Largest difference of the colours of two pixels of one background.
_SAME_BACKGROUND = 2 / 255
# Least share of the border pixels that show the background, and of the pixels if it is plain.
_BORDER = 0.25
# Distance of random points from cameras with parallel axes, scene extents.
_PARALLEL = 10.0
# Points in a view that a random one gets its depth from.
_NEIGHBOURS = 3
# Largest deviation of the depth of a random point, as a fraction.
_SPREAD = 0.1
# Least scene extent, relative to the median depth: of means that move by fractions of the extent.
_DEPTH = 1 / 6
# Opacity of the Gaussians at the start: most can become opaque or vanish within the steps of a
# first frame.
_OPACITY = 0.3


def from_points(
    points: np.ndarray, colors: np.ndarray, sh_degree: int, opacity: float = 0.3
) -> Gaussians:
    """Return a round Gaussian on every point, as large as the distance to its three nearest
    neighbours (as in 3DGS).

    Args:
        points: [P, 3], world units.
        colors: [P, 3], encoded: 1 is white.
        sh_degree: 0 to 3; all but the constant coefficient start at 0.
        opacity: of every Gaussian.

    Raises:
        ValueError: no points.
    """
    points = points.astype(np.float64)
    colors = colors.astype(np.float64)
    n = len(points)
    if not n:
        raise ValueError(
            "from_points(): `points` must be [P, 3] with P > 0, got none; give a capture with SfM "
            "points, or seed some with seed_points()."
        )
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (colors - 0.5) / SH_C0
    count = min(4, n)
    distance = KDTree(points).query(points, k=count)[0].reshape(n, count)[:, 1:]
    spacing = np.sqrt(np.mean(distance**2, axis=1)) if count > 1 else np.ones(n)
    # Coincident points would have no size, and outliers would cover the view.
    spacing = np.clip(spacing, 0.1 * np.median(spacing) + 1e-9, 10 * np.median(spacing) + 1e-9)
    return Gaussians.from_activated(
        points,
        np.repeat(spacing[:, None], 3, axis=1),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full(n, opacity),
        sh,
        **{a.name: np.full((n, *a.shape), a.initial) for a in ATTRIBUTES if a.initial is not None},
    )


def initial_points(
    views: Sequence[View],
    points: PointCloud,
    count: int,
    rng: np.random.Generator,
    background: RGB | None = None,
) -> PointCloud:
    """Return the points that Gaussians start from, at most `count`.

    Fewer than `MIN_POINTS` given ones are replaced by random points inside the views, or by
    `far_points` where few cameras stand far apart around a room; where there are few, random ones
    are added where the views show none. Points in the empty space before the cameras are left out.
    Given points get the colours of HDR views, because their own do not exceed white.

    Args:
        views: V views, at least one.
        points: P points.
        count: number of points; those in the empty space are not replaced.
        rng: draws points.
        background: encoded colour [3] behind all Gaussians; None: no pixel shows it.
    """
    points = _in_light(points, views)
    cameras = [view.camera for view in views]
    if points.count < MANY_POINTS and are_around(cameras) and _fills(views, background):
        points = PointCloud.joined([points, far_points(views, max(count - points.count, 1), rng)])
    elif points.count < MIN_POINTS:
        points = seed_points(views, count, rng, background)
    elif points.count < MANY_POINTS:
        points = fill_points(points, views, count, rng)
    points = resample_points(_outside_empty_space(points, cameras), count, rng)
    # Again, because points between two others may lie there.
    return _outside_empty_space(points, cameras)


def has_points(cameras: Sequence[Camera], points: np.ndarray) -> bool:
    """Return whether Gaussians can start from the points [P, 3]: there are enough, and cameras see
    them.
    """
    return len(points) >= MIN_POINTS and not unseen_points(cameras, points)


def unseen_points(cameras: Sequence[Camera], points: np.ndarray) -> str:
    """Return a sentence if hardly any of the points [P, 3] lies in a view; otherwise nothing, also
    without points.
    """
    some = points[:: len(points) // _CHECKED + 1]
    is_seen = np.zeros(len(some), bool)
    for camera in cameras:
        is_seen |= seen_points(camera, some)[0]
    if is_seen.sum() >= _LEAST_SEEN * len(some):
        return ""
    return (
        f"the cameras see {100 * is_seen.mean():.0f} % of the {len(points)} points, which are not "
        "used: check their axes and units"
    )


def in_empty_space(cameras: Sequence[Camera], means: np.ndarray) -> np.ndarray:
    """Return the mask of means [N] that lie in the view of a camera, nearer than its near plane.

    This camera does not render them, so that nothing moves them away. In front of other cameras
    they are fog.

    Args:
        cameras: the training cameras.
        means: [N, 3], world units.
    """
    mask = np.zeros(len(means), bool)
    for camera in cameras:
        forward = camera.world_to_camera[2]
        depths = means @ forward[:3] + forward[3]
        near = np.flatnonzero((depths > 0) & (depths < camera.near))
        pixels, _ = camera.project(np.asarray(means[near], np.float64))
        mask[near] |= in_image(camera, pixels)
    return mask


def _outside_empty_space(points: PointCloud, cameras: Sequence[Camera]) -> PointCloud:
    """Return the points that are not `in_empty_space`, or all if all are."""
    is_empty = in_empty_space(cameras, points.positions)
    return points if is_empty.all() else points.select(~is_empty)


def _in_light(points: PointCloud, views: Sequence[View]) -> PointCloud:
    """Return the points with their median colours in HDR views; their own where no such view shows
    them.
    """
    hdr_views = [view for view in views if np.isinf(view.white)]
    if not hdr_views or not points.count:
        return points
    colors = np.stack([shown_colors(view, points.positions) for view in hdr_views], dtype=float)
    unseen = np.isnan(colors).all(axis=(0, 2))
    colors[:, unseen] = points.colors[unseen]
    return points._replace(colors=np.nanmedian(colors, axis=0))


def resample_points(points: PointCloud, count: int, rng: np.random.Generator) -> PointCloud:
    """Return `count` points: a random subset, or with points added between near neighbours."""
    if points.count >= count:
        return points.select(np.sort(rng.choice(points.count, count, replace=False)))
    if points.count < 2:
        return points
    num_new = count - points.count
    parents = points.select(rng.integers(0, points.count, num_new))
    tree = KDTree(points.positions)
    neighbours = np.asarray(tree.query(parents.positions, k=min(4, points.count))[1])
    partner = neighbours[np.arange(num_new), rng.integers(1, neighbours.shape[1], num_new)]
    partners = points.select(partner)
    blend = rng.uniform(0.2, 0.8, (num_new, 1))
    between = PointCloud(
        (1 - blend) * parents.positions + blend * partners.positions,
        (1 - blend) * parents.colors + blend * partners.colors,
    )
    return PointCloud.joined([points, between])


def seed_points(
    views: Sequence[View],
    count: int,
    rng: np.random.Generator,
    background: RGB | None = None,
) -> PointCloud:
    """Return random points inside the views.

    Each view with valid pixels gets the same number of points, in the colours of random pixels that
    do not show the background. Of 64 random depths, a point gets the one at which most views show
    its colour: the frustums overlap there, and no view sees something else through it. The depths
    are uniform in 1 / depth between a third and three times the distance of the
    `focus_point`. Where the focus point is not in front of the camera, as with parallel axes, the
    distance is ten scene extents.

    Args:
        views: V views.
        count: number of points.
        rng: draws pixels and depths.
        background: encoded colour [3] behind all Gaussians; None: no pixel shows it.
    """
    focus = Focus.of([view.camera for view in views])
    blurred = [view.at(np.asarray(cv2.blur(view.image, (3, 3)))) for view in views]
    sources = [
        replace(view, mask=_shows_scene(view, background))
        for view in views
        if valid_pixels(view.mask, view.image.shape).any()
    ]
    parts = []
    for view, share in shares_of(count, sources):
        within, colors = random_pixels(view, share, rng)
        distance = focus.depth(view.camera)
        if np.isinf(distance):
            distance = _PARALLEL * focus.extent
        depths = max(distance, 10 * view.camera.near) / rng.uniform(1 / 3, 3, (_DEPTHS, share))
        points = view.camera.unproject(np.tile(within, (_DEPTHS, 1)), depths.ravel())
        counts = _agreeing_views(points, np.tile(colors, (_DEPTHS, 1)), blurred)
        best = counts.reshape(depths.shape).argmax(axis=0)
        chosen = points.reshape(*depths.shape, 3)[best, np.arange(share)]
        parts.append(PointCloud(chosen, colors))
    return PointCloud.joined([NO_POINTS, *parts])


def _agreeing_views(points: np.ndarray, colors: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Return the number of views that show each of the points [P, 3] in its colour [P]."""
    counts = np.zeros(len(points), int)
    for view in views:
        visible, pixels = seen_pixels(view.camera, points)
        error = np.abs(unit_values(view.image[pixels]) - colors[visible]).max(axis=1)
        counts[visible] += error < SAME_POINT
    return counts


def _shows_scene(view: View, background: RGB | None) -> np.ndarray:
    """Return the valid pixels [H, W] that do not show the background; all valid ones where none
    is left.
    """
    is_valid = valid_pixels(view.mask, view.image.shape)
    if background is None:
        return is_valid
    shows_scene = is_valid & ~_is_alike(unit_values(view.image), background)
    return shows_scene if shows_scene.any() else is_valid


def _fills(views: Sequence[View], background: RGB | None) -> bool:
    """Return whether few pixels of the views show the background."""
    num_shown = sum(_shows_scene(view, background).sum() for view in views)
    num_valid = sum(valid_pixels(view.mask, view.image.shape).sum() for view in views)
    return num_shown > (1 - _BORDER) * num_valid


def _is_alike(colors: np.ndarray, background: RGB | np.ndarray) -> np.ndarray:
    """Return which of the colours [..., 3] are the background's [...]."""
    return np.abs(colors - np.asarray(background)).max(axis=-1) <= _SAME_BACKGROUND


def border_color(views: Sequence[View]) -> RGB | None:
    """Return the encoded colour of the border pixels of the views, None where they have no colour
    in common.
    """
    parts = []
    for view in views:
        is_border = valid_pixels(view.mask, view.image.shape).copy()
        is_border[1:-1, 1:-1] = False
        parts.append(unit_values(view.image[is_border]))
    pixels = np.concatenate(parts)
    if not len(pixels):
        return None
    colors, counts = np.unique(np.round(255 * pixels), axis=0, return_counts=True)
    is_background = _is_alike(pixels, colors[counts.argmax()] / 255)
    if is_background.mean() < _BORDER:
        return None
    red, green, blue = np.median(pixels[is_background], axis=0).tolist()
    return red, green, blue


def mean_color(views: Sequence[View]) -> RGB:
    """Return the mean encoded colour of the valid pixels of the views."""
    means = []
    for view in views:
        pixels = view.image[valid_pixels(view.mask, view.image.shape)]
        means.append(unit_values(pixels).mean(axis=0))
    red, green, blue = np.mean(means, axis=0).tolist()
    return red, green, blue


def fill_points(
    points: PointCloud, views: Sequence[View], count: int, rng: np.random.Generator
) -> PointCloud:
    """Return `count` points: the given ones, resampled, and random ones where views show none.

    A view is divided into cells. Those that show no point get random pixels, at the mean depth of
    the nearest points in the image, which is far better than a random depth (see
    `docs/experiments/first-frame.md`).

    Args:
        points: P points.
        views: V views.
        count: number of points.
        rng: draws pixels and depths.
    """
    parts = []
    for view, share in shares_of(count, views):
        _, point_pixels, depths = seen_points(view.camera, points.positions)
        if not len(point_pixels):
            continue
        size = view.camera.size
        pixels = rng.uniform(0, size, (share, 2))
        point_cells = (point_pixels * _CELLS / size).astype(int)
        cells = (pixels * _CELLS / size).astype(int)
        is_free = np.ones((_CELLS, _CELLS), bool)
        is_free[tuple(point_cells.T)] = False
        chosen = is_free[tuple(cells.T)]
        columns, rows = pixels.astype(int).T
        if view.mask is not None:
            chosen &= view.mask[rows, columns]
        pixels = pixels[chosen]
        # Weighted by the inverse distance, the depths of the nearest points are averaged as 1 / z.
        k = min(_NEIGHBOURS, len(point_pixels))
        nearest = KDTree(point_pixels).query(pixels, k=k)
        distance = np.reshape(nearest[0], (-1, k))
        near = np.reshape(nearest[1], (-1, k))
        weights = 1 / (distance + 1e-3)
        depth = weights.sum(axis=1) / (weights / depths[near]).sum(axis=1)
        depth = depth * rng.uniform(1 - _SPREAD, 1 + _SPREAD, len(depth))
        colors = unit_values(view.image[rows[chosen], columns[chosen]])
        parts.append(PointCloud(view.camera.unproject(pixels, depth), colors))
    num_new = sum(part.count for part in parts)
    return PointCloud.joined([resample_points(points, count - num_new, rng), *parts])


@dataclass(frozen=True, eq=False)
class FirstFrameProblem:
    """Data to which the first frame is fitted."""

    start: Gaussians  #: Initial Gaussians.
    views: tuple[View, ...]  #: V views of one timestamp.
    points: np.ndarray  #: [P, 3] of the scene, world units, or none.
    #: Of the scene in world units, at least a sixth of its depth: cameras close together see far.
    extent: float
    render: RenderConfig  #: Cut-offs.

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        points: PointCloud,
        config: FitConfig,
        render: RenderConfig,
        rng: np.random.Generator,
    ) -> FirstFrameProblem:
        """Return the problem with Gaussians at the points, and at random points where the views
        show none.

        Args:
            views: V views, at least one.
            points: P points; P may be 0.
            config: number and SH degree of the Gaussians.
            render: cut-offs.
            rng: draws points.
        """
        start_points = initial_points(views, points, config.first_count, rng, render.background)
        start = from_points(*start_points, config.sh_degree, _OPACITY)
        cameras = [view.camera for view in views]
        depths = [plane.depth for plane in scene_planes(cameras, start_points.positions)]
        extent = max(scene_extent(cameras), _DEPTH * float(np.median(depths)))
        return cls(start, tuple(views), points.positions, extent, render)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the views."""
        return [view.camera for view in self.views]
