"""Points seen in several views of one timestamp: features, matches and triangulation.

Notation: a feature x [2] is a pixel position with pixel centres at +0.5, as in `Camera`; a match is
a pair of features in two views. Matching does not use the poses, so poses can be checked against
matches. `guided_matching` uses them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from morgs_mi.core.camera import Camera, unit_vectors
from morgs_mi.core.rig import central_distances, positions_of

# Pixels to which larger images are reduced: more show no corners that other views also see, and
# SIFT is slow.
_DETECTION_PIXELS = 1.3e6
MAX_FEATURES = 2500
"""Largest number of features of a view: descriptors of all pairs are compared."""
# Largest ratio of the distances of the nearest and the second descriptor (Lowe 2004).
_RATIO = 0.8
# Number of cameras up to which all pairs are matched: their number grows with the square.
_ALL_PAIRS = 24
# Nearest cameras that each of more cameras is matched with.
_NEIGHBOURS = 8
# Least number of matches that agree with one geometry: fewer agree by chance.
_MIN_MATCHES = 16
MIN_ANGLE = 1.0
"""Least spread of the views of a point, degrees: below, its depth is uncertain."""


@dataclass(frozen=True)
class Features:
    """SIFT features of one image."""

    points: np.ndarray  #: [K, 2] float64, pixels.
    descriptors: np.ndarray  #: [K, 128] float32 of length 1.
    colors: np.ndarray  #: [K, 3] float32 in [0, 1], colour of the pixel.
    #: [K, 2] float64, pixels, from the centre of the described patch along its orientation to its
    #: edge.
    axes: np.ndarray


@dataclass(frozen=True)
class Match:
    """Matched features of two views."""

    views: tuple[int, int]  #: Indices of the two views.
    features: np.ndarray  #: [M, 2] int, index of the feature in each view.


@dataclass(frozen=True)
class FeatureTracks:
    """Features of one point each in several views: observation k is a feature of track `ids[k]` in
    view `views[k]`.

    Attributes:
        ids: [n] int.
        views: [n] int.
        pixels: [n, 2].
        colors: [n, 3] in [0, 1].
    """

    ids: np.ndarray
    views: np.ndarray
    pixels: np.ndarray
    colors: np.ndarray

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.ids.max(initial=-1)) + 1


@dataclass(frozen=True)
class SharedFeatures:
    """Features of several views, and the matches between them."""

    features: tuple[Features, ...]  #: Per view.
    matches: tuple[Match, ...]  #: Per pair of views with matches.

    def without(self, views: Collection[int]) -> SharedFeatures:
        """Return them without the features of some views, by their indices."""
        return SharedFeatures(
            tuple(detect(None) if v in views else f for v, f in enumerate(self.features)),
            tuple(match for match in self.matches if not {*views} & {*match.views}),
        )

    def reprojection_errors(self, match: Match, cameras: Sequence[Camera]) -> np.ndarray:
        """Return the reprojection error of the matches of two views [M], px.

        A match is triangulated from its two features. Its error is the mean distance of the point's
        projections from the features; it is infinite for a point behind a camera.

        Args:
            match: one of `matches`, or a part of one.
            cameras: per view.
        """
        first, second = (self.features[view].points for view in match.views)
        rows, partners = match.features.T
        pixels = np.concatenate([first[rows], second[partners]])
        points = intersect_pairs(pixels, match.views, cameras)
        views = np.repeat(match.views, len(points))
        return _distances(np.tile(points, (2, 1)), views, pixels, cameras).reshape(2, -1).mean(0)

    def tracks(self) -> FeatureTracks:
        """Return the tracks of features that are matched directly or through other features, all in
        different views.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        starts = np.concatenate([[0], np.cumsum([len(f.points) for f in self.features])])
        starts = starts.astype(int)
        edges = [match.features + starts[list(match.views)] for match in self.matches]
        rows, columns = np.concatenate([np.zeros((0, 2), int), *edges]).T
        graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(starts[-1], starts[-1]))
        track = connected_components(graph, directed=False)[1]
        views = np.repeat(np.arange(len(self.features)), np.diff(starts))
        # Tracks with at least two features, all in different views.
        sizes = np.bincount(track)
        distinct = np.bincount(np.unique(np.stack([track, views]), axis=1)[0], minlength=len(sizes))
        members = np.flatnonzero(((sizes >= 2) & (distinct == sizes))[track])
        _, track = np.unique(track[members], return_inverse=True)
        return FeatureTracks(
            track,
            views[members],
            np.concatenate([f.points for f in self.features])[members],
            np.concatenate([f.colors for f in self.features])[members],
        )

    def triangulated(
        self, cameras: Sequence[Camera], max_error: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the triangulated points [P, 3] float32, world units, and their colours [P, 3] in
        [0, 1].

        Args:
            cameras: per view.
            max_error: largest distance of a point's projection from any of its features, px.
        """
        close = []
        for match in self.matches:
            good = self.reprojection_errors(match, cameras) <= max_error
            close.append(replace(match, features=match.features[good]))
        tracks = replace(self, matches=tuple(close)).tracks()
        points = intersect(tracks.ids, tracks.views, tracks.pixels, cameras, tracks.count)
        distances = _distances(points[tracks.ids], tracks.views, tracks.pixels, cameras)
        # The spread of a point's views: twice the largest angle between its rays and their mean.
        with np.errstate(invalid="ignore"):
            rays = unit_vectors(points[tracks.ids] - positions_of(cameras)[tracks.views])
            means = [np.bincount(tracks.ids, axis) for axis in rays.T]
            mean = unit_vectors(np.stack(means, axis=1))
            angles = np.rad2deg(np.arccos(np.clip((rays * mean[tracks.ids]).sum(1), -1, 1)))
        widest = np.zeros(len(points))
        np.maximum.at(widest, tracks.ids, np.nan_to_num(angles))
        good = 2 * widest >= MIN_ANGLE
        good[tracks.ids[distances > max_error]] = False
        colors = np.stack([np.bincount(tracks.ids, band) for band in tracks.colors.T], axis=1)
        colors = (colors / np.bincount(tracks.ids)[:, None])[good]
        return points[good].astype(np.float32), colors.astype(np.float32)


def detect(image: np.ndarray | None, mask: np.ndarray | None = None) -> Features:
    """Return the SIFT features of an image uint8 [H, W, 3] where `mask` [H, W] is true; none
    without an image.
    """
    no_points = np.zeros((0, 2))
    none = Features(
        no_points, np.zeros((0, 128), np.float32), np.zeros((0, 3), np.float32), no_points
    )
    if image is None:
        return none
    height, width = image.shape[:2]
    size = reduced_size(width, height, _DETECTION_PIXELS)
    grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    # Without precise upscaling OpenCV's features are off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return none
    pixel_scale = width / size[0], height / size[1]
    points = (np.array([k.pt for k in keypoints]) + 0.5) * pixel_scale
    # RootSIFT: square roots of the normalised descriptors are easier to distinguish (Arandjelovic
    # 2012).
    descriptors = np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
    columns, rows = np.clip(points.astype(int), 0, (width - 1, height - 1)).T
    colors = image[rows, columns].astype(np.float32) / 255
    angles, sizes = np.array([(np.deg2rad(k.angle), k.size) for k in keypoints]).T
    axes = 0.5 * sizes[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Features(points, descriptors, colors, axes * pixel_scale)


def reduced_size(width: int, height: int, pixels: float) -> tuple[int, int]:
    """Return the width and height of an image reduced to a number of pixels."""
    scale = min(1.0, np.sqrt(pixels / (width * height)))
    return round(width * scale), round(height * scale)


def match_views(features: Sequence[Features], cameras: Sequence[Camera]) -> SharedFeatures:
    """Return features with the matches between all pairs of up to 24 views, or of each view and its
    8 nearest ones.

    Only matches that are consistent with a common epipolar geometry are returned, for any such
    geometry.

    Args:
        features: per view.
        cameras: per view.
    """
    count = len(cameras)
    neighbours = count if count <= _ALL_PAIRS else _NEIGHBOURS
    positions = positions_of(cameras)
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    ranks = distances.argsort().argsort()
    matches = []
    for i, j in combinations(range(count), 2):
        a = features[i]
        b = features[j]
        is_near = min(ranks[i, j], ranks[j, i]) <= neighbours
        if not is_near or min(len(a.points), len(b.points)) < 2:
            continue
        pairs = mutual_neighbours(descriptor_distances(a, b))
        if len(pairs) < _MIN_MATCHES:
            continue
        x = a.points[pairs[:, 0]]
        y = b.points[pairs[:, 1]]
        with suppress(cv2.error):  # raised for some matches that fit no geometry
            _, inliers = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, 2.0, 0.999, 5000)
            if np.count_nonzero(inliers) >= _MIN_MATCHES:
                matches.append(Match((i, j), pairs[inliers.ravel() > 0]))
    return SharedFeatures(tuple(features), tuple(matches))


def descriptor_distances(a: Features, b: Features) -> np.ndarray:
    """Return the distances of all descriptors of two views [K, L]."""
    return np.sqrt(np.maximum(2 - 2 * a.descriptors @ b.descriptors.T, 0))


def mutual_neighbours(distances: np.ndarray) -> np.ndarray:
    """Return the pairs [M, 2] that are mutual nearest neighbours and pass Lowe's ratio test, from
    distances [K, L].
    """
    forth = distances.argmin(1)
    back = distances.argmin(0)
    rows = np.arange(len(forth))
    first, second = np.partition(distances, 1, axis=1)[:, :2].T
    good = (back[forth] == rows) & (first < _RATIO * second)
    return np.stack([rows, forth], axis=1)[good]


def intersect(
    track: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera], count: int
) -> np.ndarray:
    """Return the points [count, 3] with the least algebraic distance to the rays of their
    observations.

    Observation k is the pixel position `pixels[k]` of point `track[k]` in view `views[k]`.
    """
    # Poses relative to the rig's centre and size make a system of equations well conditioned.
    positions = positions_of(cameras)
    middle = positions.mean(0)
    scale = central_distances(positions).max() or 1.0
    V = np.array([camera.world_to_camera[:3] for camera in cameras])
    V[:, :, 3] = (V[:, :, :3] @ middle + V[:, :, 3]) / scale
    V = V[views]
    K = np.array([camera.K for camera in cameras])[views]
    x = (pixels - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]  # at depth 1
    rows = x[:, :, None] * V[:, 2:3] - V[:, :2]
    system = np.zeros((count, 4, 4))
    np.add.at(system, track, np.einsum("kri,krj->kij", rows, rows))
    solution = np.linalg.eigh(system)[1][:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return solution[:, :3] / solution[:, 3:] * scale + middle


def intersect_pairs(
    pixels: np.ndarray, views: tuple[int, int], cameras: Sequence[Camera]
) -> np.ndarray:
    """Return the points [M, 3] that two views see, as `intersect` does. The first M rows of
    `pixels` [2 M, 2] are their positions in the first view, the others in the second view.
    """
    count = len(pixels) // 2
    return intersect(np.tile(np.arange(count), 2), np.repeat(views, count), pixels, cameras, count)


def _distances(
    points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera]
) -> np.ndarray:
    """Return the distance of each point's projection [n] from its pixel, px, infinite behind the
    camera.
    """
    projections = np.empty_like(pixels)
    depths = np.empty(len(points))
    with np.errstate(divide="ignore", invalid="ignore"):
        for view in np.unique(views):
            of_view = views == view
            projections[of_view], depths[of_view] = cameras[view].project(points[of_view])
        error = np.linalg.norm(projections - pixels, axis=1)
    return np.where((depths > 0) & np.isfinite(error), error, np.inf)
