"""Colour correction between cameras.

A correction is a matrix on (R, G, B) in linear light. It models differences of gain, white balance
and cross-talk between sensors. Matrices are fitted to the colours of shared points: matching
features that are consistent with the poses. The reference camera is not changed. The other cameras
are corrected one by one: the next one is the camera that shares most points with the corrected
ones.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.capture.features import (
    Features,
    Match,
    detect,
    match_views,
    reprojection_errors,
    values_at,
)
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_light, encode_light

_LOG = logging.getLogger(__name__)

# A matrix has nine numbers; features are noisy.
_MIN_SAMPLES = 30
_MAX_ERROR = 2.0
# Well-exposed pixel values, of 0..255; those nearly black or white do not determine a gain.
_DARK = 12
_BRIGHT = 243
_BLUR = 0.008  # standard deviation of the blur around a feature, as a fraction of the width

# Tables: the light of each byte, and the byte of 65536 levels of light.
_LINEAR = decode_light(np.arange(256, dtype=np.float32) / np.float32(255)).astype(np.float32)
_ENCODED = np.rint(255 * encode_light(np.arange(65536) / 65535)).astype(np.uint8)


@dataclass(frozen=True)
class ColorFit:
    """Colour correction of all cameras towards a reference camera."""

    reference: int  #: Index of the reference camera, which is not changed.
    #: Per camera [3, 3]; None for the reference, and for a camera that shares too few points with
    #: the others.
    matrices: tuple[np.ndarray | None, ...]
    samples: tuple[int, ...]  #: Per camera, number of points shared with others.
    #: Per camera, mean dE2000 of its points against the other views' colours; NaN without points.
    recorded_delta_e: tuple[float, ...]
    delta_e: tuple[float, ...]  #: The same after the correction.

    def correction(self, view: int) -> ColorCorrection | None:
        """Return the correction of a view, None if it is not changed."""
        matrix = self.matrices[view]
        return None if matrix is None else ColorCorrection(matrix)


@dataclass(frozen=True)
class ColorCorrection:
    """Colour correction of one camera's images, towards the other cameras."""

    matrix: np.ndarray  #: Matrix on linear (R, G, B) [3, 3].

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the corrected image [H, W, 3], uint8, or float32 of linear light."""
        if image.dtype != np.uint8:
            return np.maximum(_corrected(image, self.matrix), 0)
        return _encode(_corrected(_LINEAR[image], self.matrix))


def fit_colors(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray | None],
    masks: Sequence[np.ndarray | None],
    reference: int | None = None,
) -> ColorFit:
    """Fit the correction that maps each view's colours of shared points to the colours in the
    reference view.

    Args:
        cameras: C views.
        images: per view an image of one instant, uint8 [H, W, 3]; None for a view that is not
            corrected.
        masks: per view the mask of valid pixels [H, W], or None.
        reference: index of the reference view; by default the one that shares most points with the
            others.
    """
    features = [detect(image, mask) for image, mask in zip(images, masks, strict=True)]
    pairs, colors = matched_colors(cameras, images, features, match_views(features, cameras))
    counts = _shared_counts(pairs, len(cameras))
    samples = counts.sum(1)
    start = int(samples.argmax()) if reference is None else reference
    corrected: dict[int, np.ndarray] = {start: colors[start]}
    matrices: list[np.ndarray | None] = [None] * len(cameras)
    while len(corrected) < len(cameras):
        view = _next_view(counts, list(corrected))
        if counts[view, list(corrected)].sum() >= _MIN_SAMPLES:
            matrices[view] = matrix = _fit(*_shared_colors(view, pairs, colors, corrected))
            corrected[view] = _corrected(colors[view], matrix)
        else:
            name = cameras[view].name
            _LOG.warning("%s keeps its colours: too few points in common with the others.", name)
            corrected[view] = colors[view]
            counts[view] = counts[:, view] = 0  # no other view is corrected towards it
    return ColorFit(
        reference=start,
        matrices=tuple(matrices),
        samples=tuple(samples.tolist()),
        recorded_delta_e=_differences(pairs, colors),
        delta_e=_differences(pairs, [corrected[view] for view in range(len(cameras))]),
    )


def _shared_counts(pairs: Sequence[Match], count: int) -> np.ndarray:
    """Return the numbers of points that two of `count` views share [C, C]."""
    counts = np.zeros((count, count), int)
    for match in pairs:
        counts[match.views] = counts[match.views[::-1]] = len(match.features)
    return counts


def _next_view(counts: np.ndarray, corrected: list[int]) -> int:
    """Return the view that shares most points with the corrected ones."""
    shared_counts = counts[:, corrected].sum(1)
    shared_counts[corrected] = -1
    return int(shared_counts.argmax())


def matched_colors(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray | None],
    features: Sequence[Features],
    matches: Sequence[Match],
) -> tuple[list[Match], list[np.ndarray]]:
    """Return the well-exposed matches that fit the poses, and the linear colours [K, 3] of all
    features.

    Args:
        cameras: C views.
        images: per view uint8 [H, W, 3], or None for a view without features.
        features: per view, in pixels of `images`.
        matches: from `match_views`.
    """
    colors = [
        np.zeros((0, 3)) if i is None else _colors_at(i, f.points)
        for i, f in zip(images, features, strict=True)
    ]
    return [_reliable(match, features, cameras, colors) for match in matches], colors


def _colors_at(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the linear colours [K, 3] around points [K, 2].

    Features are edges, which two views sample differently. A wider mean reduces this error (dE2000
    between equal cameras: 3.2 with 1 px, 2.1 with 2.6 px at a width of 320), until the mean
    includes the background.
    """
    light = cv2.GaussianBlur(_LINEAR[image], (0, 0), max(1.0, _BLUR * image.shape[1]))
    return values_at(light, points).astype(np.float64)


def _reliable(
    match: Match,
    features: Sequence[Features],
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
) -> Match:
    """Return the features of a match that fit the poses and are well exposed in both views."""
    good = reprojection_errors(match, features, cameras) <= _MAX_ERROR
    for k, view in enumerate(match.views):
        good &= _well_exposed(colors[view][match.features[:, k]])
    return Match(match.views, match.features[good])


def _well_exposed(colors: np.ndarray) -> np.ndarray:
    """Return the mask of linear colours [M, 3] that are neither nearly black nor nearly white."""
    return ((colors > _LINEAR[_DARK]) & (colors < _LINEAR[_BRIGHT])).all(1)


def _shared_colors(
    view: int,
    pairs: Sequence[Match],
    colors: Sequence[np.ndarray],
    corrected: dict[int, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours [M, 3] of the same points in a view and in the views already corrected."""
    mine = []
    theirs = []
    for pair in pairs:
        if view in pair.views and (other := sum(pair.views) - view) in corrected:
            k = pair.views.index(view)
            mine.append(colors[view][pair.features[:, k]])
            theirs.append(corrected[other][pair.features[:, 1 - k]])
    return np.concatenate(mine), np.concatenate(theirs)


def _fit(mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3], fitted a second time without outliers, which are highlights and
    wrong matches.
    """
    errors = delta_e(_corrected(mine, _least_squares(mine, theirs)), theirs)
    good = errors <= 3 * np.median(errors)
    return _least_squares(mine[good], theirs[good])


def _least_squares(mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(mine, theirs, rcond=None)[0].T


def _corrected(light: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return corrected linear colours [..., 3]."""
    return light @ matrix.T.astype(light.dtype)


def delta_e(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dE2000 [M] between linear sRGB colours [M, 3]."""
    import colour

    lab = [colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(light, 0, 1), "sRGB")) for light in (a, b)]
    return colour.delta_E(*lab, method="CIE 2000")


def _differences(pairs: Sequence[Match], colors: Sequence[np.ndarray]) -> tuple[float, ...]:
    """Return per view the mean dE2000 of its points against their colours in the other views."""
    differences: list[list[np.ndarray]] = [[] for _ in colors]
    for pair in pairs:
        if len(pair.features):
            a, b = (colors[view][pair.features[:, k]] for k, view in enumerate(pair.views))
            difference = delta_e(a, b)
            for view in pair.views:
                differences[view].append(difference)
    return tuple(map(_mean, differences))


def _mean(batches: Sequence[np.ndarray]) -> float:
    return float(np.mean(np.concatenate(batches))) if batches else float("nan")


def _encode(light: np.ndarray) -> np.ndarray:
    return _ENCODED[(np.clip(light, 0, 1) * 65535 + 0.5).astype(np.uint16)]
