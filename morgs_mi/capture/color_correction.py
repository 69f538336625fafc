"""Colours that agree between cameras and over time.

Corrections are made in linear light, where another gain, white balance or sensor is a matrix on (R, G, B). They are
fitted to the colours of points that views have in common: features that match, and on which the poses agree. The
reference camera keeps its colours; the others follow from those already corrected that they have most in common with.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from morgs_mi.capture.features import Features, Match, detect, match_views, reprojection_errors
from morgs_mi.core.camera import Camera

__all__ = ["COLOR_METHODS", "ColorCorrection", "ColorFit", "fit_colors"]

_LOG = logging.getLogger(__name__)

# By name: colour-science's method and its settings.
COLOR_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "linear": ("Cheung 2004", {"terms": 3}),
    "root-polynomial": ("Finlayson 2015", {"degree": 2, "root_polynomial_expansion": True}),
    "vandermonde": ("Vandermonde", {"degree": 2}),
}
# A matrix has nine numbers; features are noisy.
_MIN_SAMPLES, _MAX_ERROR = 30, 2.0
# What is nearly black or white says nothing about a gain, of 0..255.
_DARK, _BRIGHT = 12, 243
_BLUR = 0.008  # of the width
_THUMB = 96  # pixels across that are enough for a median


def _decoded(codes: np.ndarray) -> np.ndarray:
    """Return the light, 0 to 1, of sRGB's codes, 0 to 255 and between (IEC 61966-2-1)."""
    signal = codes / np.float32(255)
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _decoded(np.arange(256, dtype=np.float32))
_LIGHT = np.arange(65536) / 65535
_ENCODED = np.where(_LIGHT <= 0.0031308, 12.92 * _LIGHT, 1.055 * _LIGHT ** (1 / 2.4) - 0.055)
_ENCODED = np.rint(255 * _ENCODED).astype(np.uint8)


@dataclass(frozen=True)
class ColorFit:
    """What brings the cameras' colours together.

    Attributes:
        method: one of `COLOR_METHODS`.
        reference: index of the camera that keeps its colours.
        matrices: per camera; None for the reference, and for a camera that has too little in common with the others.
        samples: per camera, points that it has in common with others.
        before: per camera, mean dE2000 of these against the other views' colours; NaN without any.
        after: the same after the correction.
    """

    method: str
    reference: int
    matrices: tuple[np.ndarray | None, ...]
    samples: tuple[int, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True)
class ColorCorrection:
    """What one camera's pictures need to agree with the other cameras' and with its own first.

    Attributes:
        method: one of `COLOR_METHODS`.
        matrix: of the correction; None for none.
        first: a small version of the first picture, where gains are to be undone; None: they stay.
    """

    method: str = "linear"
    matrix: np.ndarray | None = None
    first: np.ndarray | None = None

    @classmethod
    def of(cls, fit: ColorFit | None, view: int, first: np.ndarray | None) -> ColorCorrection:
        """Return the tone of a view, relative to its `first` picture if that is given."""
        matrix = None if fit is None else fit.matrices[view]
        return cls(fit.method if fit else "linear", matrix, None if first is None else _thumb(first))

    def gain(self, image: np.ndarray) -> float:
        """Return the factor in light between the first picture and this one: the median of what is well exposed.

        Cameras do not move here, so most pixels show what they showed then.
        """
        if self.first is None:
            return 1.0
        now = _thumb(image)
        both = np.stack([self.first, now])
        good = ((both > _DARK) & (both < _BRIGHT)).all((0, -1))
        return float(np.median(_decoded(now[good]) / _decoded(self.first[good]))) if good.sum() >= _MIN_SAMPLES else 1.0

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the picture uint8 [H, W, 3] as it should have been."""
        gain = self.gain(image)
        if self.matrix is None:
            return image if gain == 1 else cv2.LUT(image, _encode(_LINEAR / gain))
        return _encode(_corrected(_LINEAR[image] / np.float32(gain), self.matrix, self.method))


def fit_colors(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray | None],
    masks: Sequence[np.ndarray | None],
    method: str = "linear",
    reference: int | None = None,
) -> ColorFit:
    """Fit what makes all views show points in the colours that the reference view shows.

    Args:
        cameras: C views.
        images: a picture of one instant per view, uint8 [H, W, 3], or None: that view keeps its colours.
        masks: per view where pixels are valid, or None.
        method: one of `COLOR_METHODS`.
        reference: index of the view that keeps its colours; by default the one with the most in common.
    """
    features = [detect(image, mask) for image, mask in zip(images, masks, strict=True)]
    seen = [np.zeros((0, 3)) if i is None else _colors_at(i, f.points) for i, f in zip(images, features, strict=True)]
    pairs = [_agreeing(match, features, cameras, seen) for match in match_views(features, cameras)]
    counts = np.zeros((len(cameras),) * 2, int)
    for match in pairs:
        counts[match.views] = counts[match.views[::-1]] = len(match.features)
    start = int(counts.sum(1).argmax()) if reference is None else reference
    corrected: dict[int, np.ndarray] = {start: seen[start]}
    matrices: list[np.ndarray | None] = [None] * len(cameras)
    while len(corrected) < len(cameras):
        known = counts[:, list(corrected)].sum(1)
        known[list(corrected)] = -1
        view = int(known.argmax())
        if known[view] >= _MIN_SAMPLES:
            matrices[view] = matrix = _fit(*_against(view, pairs, seen, corrected), method)
            corrected[view] = _corrected(seen[view], matrix, method)
        else:
            _LOG.warning("%s keeps its colours: too few points in common with the others.", cameras[view].name)
            corrected[view] = seen[view]
            counts[view] = counts[:, view] = 0  # nobody is corrected towards it
    after = [corrected[view] for view in range(len(cameras))]
    return ColorFit(
        method,
        start,
        tuple(matrices),
        tuple(sum(len(pair.features) for pair in pairs if view in pair.views) for view in range(len(cameras))),
        _differences(pairs, seen),
        _differences(pairs, after),
    )


def _colors_at(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the linear colours [K, 3] around points [K, 2].

    Features are edges, which two views sample differently: the wider the mean, the smaller that error (dE2000 of 3.2
    between equal cameras with 1 px, 2.1 with 2.6 px at a width of 320), until it takes in what lies behind.
    """
    light = cv2.GaussianBlur(_LINEAR[image], (0, 0), max(1.0, _BLUR * image.shape[1]))
    columns, rows = np.clip(points.astype(int), 0, (image.shape[1] - 1, image.shape[0] - 1)).T
    return light[rows, columns].astype(np.float64)


def _agreeing(match: Match, features: Sequence[Features], cameras: Sequence[Camera], seen: Sequence) -> Match:
    """Keep the features on which the poses agree, and that are well exposed in both views."""
    good = reprojection_errors(match, features, cameras) <= _MAX_ERROR
    for k, view in enumerate(match.views):
        colors = seen[view][match.features[:, k]]
        good &= ((colors > _LINEAR[_DARK]) & (colors < _LINEAR[_BRIGHT])).all(1)
    return Match(match.views, match.features[good])


def _against(
    view: int, pairs: Sequence[Match], seen: Sequence[np.ndarray], corrected: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a view's colours [M, 3] and those of the same points in the views that are corrected already."""
    mine, theirs = [], []
    for pair in pairs:
        if view in pair.views and (other := sum(pair.views) - view) in corrected:
            k = pair.views.index(view)
            mine.append(seen[view][pair.features[:, k]])
            theirs.append(corrected[other][pair.features[:, 1 - k]])
    return np.concatenate(mine), np.concatenate(theirs)


def _fit(mine: np.ndarray, theirs: np.ndarray, method: str) -> np.ndarray:
    """Fit a correction, and once more without what it explains worst: highlights, wrong matches."""
    from colour.characterisation import matrix_colour_correction

    name, settings = COLOR_METHODS[method]
    matrix = matrix_colour_correction(mine, theirs, name, **settings)
    errors = delta_e(_corrected(mine, matrix, method), theirs)
    good = errors <= 3 * np.median(errors)
    return matrix_colour_correction(mine[good], theirs[good], name, **settings)


def _corrected(light: np.ndarray, matrix: np.ndarray, method: str) -> np.ndarray:
    """Apply a correction to linear colours [..., 3]."""
    from colour.characterisation import apply_matrix_colour_correction

    if method == "linear":  # a polynomial of these terms only
        return light @ matrix.T.astype(light.dtype)
    name, settings = COLOR_METHODS[method]
    return apply_matrix_colour_correction(np.maximum(light, 0), matrix, name, **settings)


def delta_e(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dE2000 [M] between linear sRGB colours [M, 3]."""
    import colour

    lab = [colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(light, 0, 1), "sRGB")) for light in (a, b)]
    return colour.delta_E(*lab, method="CIE 2000")


def _differences(pairs: Sequence[Match], colors: Sequence[np.ndarray]) -> tuple[float, ...]:
    """Return per view the mean dE2000 of its points against the other views' colours of them."""
    found: list[list[np.ndarray]] = [[] for _ in colors]
    for pair in pairs:
        a, b = (colors[view][pair.features[:, k]] for k, view in enumerate(pair.views))
        if len(a):
            for view in pair.views:
                found[view].append(delta_e(a, b))
    return tuple(float(np.mean(np.concatenate(values))) if values else float("nan") for values in found)


def _thumb(image: np.ndarray) -> np.ndarray:
    """Return the picture some pixels small, as float32: rounded codes would round the gain to 2 %."""
    height, width = image.shape[:2]
    across = min(_THUMB, width)
    return cv2.resize(
        image.astype(np.float32), (across, max(1, round(height * across / width))), interpolation=cv2.INTER_AREA
    )


def _encode(light: np.ndarray) -> np.ndarray:
    return _ENCODED[(np.clip(light, 0, 1) * 65535 + 0.5).astype(np.uint16)]
