"""Exposure and white balance of each camera and frame: a gain and a bias per channel. Beyond the
paper.

A camera shows the display-referred colours x of the scene as y = gain x + bias. As sRGB is 1.055
l^(1/2.4) - 0.055 of the light l, a factor on the light is such a map, except in the darkest tones.
It is solved in closed form by least squares with a prior, weighted against outliers: motion,
highlights, and errors of a rendering.

Between cameras, x is a rendering of Gaussians that all cameras share (see `fit.balance`). Over
time, x is the reference image of the same camera. Static pixels then do not change with the
exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.method.change import NORMAL

LEAST_CHANGE = 3e-3
"""Change of tones over time, of 1, below which an image is not corrected: it is an error of the
measurement.
"""

# Weights of the priors of gain and bias, relative to all pixels. The first acts where nearly all
# pixels are dark. The second, for the bias beyond the bias of a factor on the light, acts where
# images have little contrast: a gain explains a change there.
_WEIGHTS = (1e-4, 0.02)
# Values, of 1, that are neither nearly black nor nearly white.
_DARK = 0.03
_BRIGHT = 0.97
# Most steps of the reweighted least squares, and the least scale of its errors, of 1.
_STEPS = 13
_LEAST_SCALE = 1e-3
# Change of gain and bias in a step at which it ends, of 1: a hundredth of a grey level.
_CONVERGED = 4e-5
# Least number of pixels that count, of which outliers are few.
_MIN_PIXELS = 30
# Gains beyond 4, and inverse ones, are no exposures: the images do not show the same.
_MAX_LOG_GAIN = np.log(4)
# Width of the thumbnails on which changes over time are measured, px: means of pixels have less
# noise.
_WIDTH = 96
# Share of the pixels under one of a thumbnail that must count; 1 but for rounding.
_ALL_VALID = 0.99
# sRGB is 1.055 l^(1/2.4) - 0.055: a gain g of the light's root comes with the bias 0.055 (g - 1).
_TOE = 0.055
_TONES = np.array([0.1, 0.5, 0.9])[:, None]
# Tones between which most of an image lies: cameras are to agree there.
_MIDDLE_TONES = np.repeat([[0.2], [0.6]], 3, axis=1)


@dataclass(frozen=True)
class Exposure:
    """Exposure and white balance of an image: recorded = gain * scene + bias, display-referred in
    [0, 1].
    """

    gain: tuple[float, ...] = (1.0, 1.0, 1.0)  #: Of R, G and B.
    bias: tuple[float, ...] = (0.0, 0.0, 0.0)  #: Of R, G and B.

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        """Return how the camera shows colours [..., 3] of the scene; not clipped."""
        return colors * self.gain + self.bias

    def corrected(self, image: np.ndarray) -> np.ndarray:
        """Return the image [H, W, 3], uint8 or encoded floats, in the scene's colours; clipped
        values stay lost.
        """
        if self == Exposure():
            return image
        gain, bias = np.array((self.gain, self.bias))
        if image.dtype != np.uint8:
            return _bent((_straightened(image) - bias) / gain).astype(np.float32)
        table = 255 * ((np.arange(256)[:, None] / 255 - bias) / gain)
        return cv2.LUT(image, np.clip(np.rint(table), 0, 255).astype(np.uint8)[None])

    def after(self, first: Exposure) -> Exposure:
        """Return the exposure that acts as `first` and then this one."""
        gain = np.array(self.gain)
        return _exposure(gain * first.gain, gain * first.bias + self.bias)

    def without(self, first: Exposure) -> Exposure:
        """Return the exposure that, after `first`, acts as this one."""
        gain = np.array(self.gain) / first.gain
        return _exposure(gain, np.array(self.bias) - gain * first.bias)

    @property
    def change(self) -> float:
        """Largest change of a dark, middle or bright tone, of 1."""
        return float(np.abs(self(_TONES) - _TONES).max())


def fit_exposure(
    scene: np.ndarray,
    recorded: np.ndarray,
    mask: np.ndarray | None = None,
    prior: Exposure | None = None,
    weights: tuple[float, float] = _WEIGHTS,
) -> Exposure:
    """Return the exposure that shows the colours of a scene as a recorded image.

    Args:
        scene: colours [H, W, 3] in [0, 1].
        recorded: image of the same pixels, likewise.
        mask: pixels that count [H, W]; None: all.
        prior: expected exposure; None: no change.
        weights: of the priors of gain and bias, relative to all pixels.

    Returns:
        The exposure, or the prior where it is not determined: with few well-exposed pixels, and for
        images that do not show the same.
    """
    prior = prior or Exposure()
    good = np.ones(scene.shape[:-1], bool) if mask is None else mask
    for values in (recorded, scene):
        r, g, b = np.moveaxis((values > _DARK) & (values < _BRIGHT), -1, 0)
        good = good & r & g & b
    if good.sum() < _MIN_PIXELS:
        return prior
    x = scene[good].astype(float)
    y = recorded[good].astype(float)
    lines = [_line(x[:, c], y[:, c], (prior.gain[c], prior.bias[c]), weights) for c in range(3)]
    gain, bias = np.transpose(lines)
    plausible = gain.min() > 0 and np.abs(np.log(gain)).max() < _MAX_LOG_GAIN
    return _exposure(gain, bias) if plausible else prior


def _line(
    x: np.ndarray, y: np.ndarray, prior: Sequence[float], weights: tuple[float, float]
) -> tuple[float, float]:
    """Return slope and intercept of y over x [P] by reweighted least squares (Geman and McClure
    1987).
    """
    # The change of the gain, and of the bias beyond the bias of a factor on the light.
    rows = np.stack([x + _TOE, np.ones_like(x)])
    rest = y - prior[0] * x - prior[1]
    regular = len(x) * np.diag(weights)
    counts = np.ones_like(x)
    change = np.zeros(2)
    for _ in range(_STEPS):
        last = change
        weighted_rows = rows * counts
        change = np.linalg.solve(weighted_rows @ rows.T + regular, weighted_rows @ rest)
        if np.abs(change - last).max() < _CONVERGED:
            break
        errors = rest - change @ rows
        scale = 2 * max(NORMAL * _median(np.abs(errors)), _LEAST_SCALE)
        counts = (1 + (errors / scale) ** 2) ** -2.0  # small for outliers
    return float(prior[0] + change[0]), float(prior[1] + change[1] + _TOE * change[0])


def _median(values: np.ndarray) -> float:
    """Return the median of finite numbers [P], P > 1. NumPy also searches for NaN, which takes a
    fifth of a fit.
    """
    middle = len(values) // 2
    values = np.partition(values, middle)
    lower_half = values[: (len(values) + 1) // 2]  # with the middle of an odd number of them
    return float((lower_half.max() + values[middle]) / 2)


def centred(exposures: Sequence[Exposure]) -> tuple[Exposure, ...]:
    """Return the exposures of all cameras relative to the one that most of them agree on.

    Which of them are right is unknown: all could be brighter and the scene darker. The reference
    shows a dark and a bright tone as their medians over the cameras. A few dark cameras would move
    a mean away from all others, and the rendering of a view between those with it.
    """
    dark = np.median([exposure(_MIDDLE_TONES[0]) for exposure in exposures], axis=0)
    bright = np.median([exposure(_MIDDLE_TONES[1]) for exposure in exposures], axis=0)
    gain = (bright - dark) / (_MIDDLE_TONES[1] - _MIDDLE_TONES[0])
    reference = _exposure(gain, dark - gain * _MIDDLE_TONES[0])
    return tuple(exposure.without(reference) for exposure in exposures)


def common_change(exposures: Sequence[Exposure]) -> Exposure:
    """Return the change that all cameras show, due to the scene's light, or no change if they
    differ too much.

    The cameras' common change is their median, if most are nearer to it than half of its size.
    """
    if len(exposures) < 3:
        return Exposure()
    middle = _exposure(*np.median(np.array([(e.gain, e.bias) for e in exposures]), axis=0))
    middle_tones = middle(_TONES)
    spread = float(np.median([np.abs(e(_TONES) - middle_tones).max() for e in exposures]))
    return middle if spread < 0.5 * middle.change else Exposure()


def follow_exposure(
    reference: np.ndarray,
    image: np.ndarray,
    mask: np.ndarray | None = None,
    last: Exposure | None = None,
) -> Exposure:
    """Return the exposure of an image relative to an earlier one of the same fixed camera.

    Args:
        reference: the earlier image, uint8 [H, W, 3].
        image: the later one, likewise.
        mask: pixels that count [H, W]; None: all.
        last: exposure of the last frame, the prior; None: the reference's exposure.
    """
    return fit_exposure(*reduced(reference, image, mask), last)


def reduced(
    reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return thumbnails of two images, of 1, and of the mask of the pixels that count, from which
    `fit_exposure` takes the change between them; arguments as for `follow_exposure`.
    """
    small_mask = None if mask is None else thumbnail(mask.astype(np.float32), _WIDTH) > _ALL_VALID
    return _reduced(reference), _reduced(image), small_mask


def _reduced(image: np.ndarray) -> np.ndarray:
    """Return the thumbnail of an image of uint8, of 1."""
    return thumbnail(thumbnail(image, 4 * _WIDTH).astype(np.float32) / 255, _WIDTH)


def thumbnail(image: np.ndarray, most: int) -> np.ndarray:
    """Return an image, no wider than `most` pixels."""
    height, width = image.shape[:2]
    size = (min(width, most), max(1, round(height * min(1, most / width))))
    if width > 3 * most:  # OpenCV halves an image several times as fast
        image = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _straightened(encoded: np.ndarray) -> np.ndarray:
    """Return encoded values, with sRGB's root of the light also above white, where the curve is
    logarithmic.
    """
    return np.where(
        encoded > 1, (1 + _TOE) * np.exp((np.maximum(encoded, 1) - 1) / (1 + _TOE)) - _TOE, encoded
    )


def _bent(root: np.ndarray) -> np.ndarray:
    """Return the encoded values, not negative, of which `_straightened` makes these."""
    above = 1 + (1 + _TOE) * np.log((np.maximum(root, 1) + _TOE) / (1 + _TOE))
    return np.where(root > 1, above, np.maximum(root, 0))


def _exposure(gain: np.ndarray, bias: np.ndarray) -> Exposure:
    return Exposure(tuple(map(float, gain)), tuple(map(float, bias)))
