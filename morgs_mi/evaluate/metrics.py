"""Errors of images, motions and masks, in NumPy and float64 for every backend.

Images are display-referred RGB (or one channel), float in [0, 1] or uint8.

Quality over time: the variation of static pixels and the slope of a score.

I_t is frame t of one fixed view, display-referred in [0, 1]; I'_t is the recorded frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import correlate1d

from morgs_mi.core.color_space import decode_light, unit_values
from morgs_mi.evaluate.results import VariationScores
from morgs_mi.platform.checks import check_mask, valid_pixels
from morgs_mi.platform.threads import map_in_threads

# Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment", TIP 2004.
WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
# Of the mu-law, by which papers on HDR compare images.
_MU = 5000
# Rows of an image whose colours are compared at once; the temporaries of a whole image exceed the
# cache.
_ROWS = 32
_CHANGE_WINDOW = 5
_SIGMAS = 4
_GREY_LEVEL = 1 / 255


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return 10 log10(1 / mean squared error) in dB; infinite for equal images.

    Args:
        image: [H, W, 3] or [H, W].
        truth: likewise.
        mask: [H, W] bool, the pixels that count; the result is NaN if there are none.

    Raises:
        ValueError: the sizes differ.
    """
    image, truth = unit_pair("psnr", image, truth, mask)
    return psnr_of(mean_over(np.square(image - truth), mask))


def psnr_mu(light: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the PSNR of tonemapped linear light, log(1 + mu x) / log(1 + mu) with mu = 5000, in
    dB.

    x is relative to the brightest true value and clipped to [0, 1] (Kalantari and Ramamoorthi, TOG
    2017). Arguments, apart from their encoding, and errors are as for `psnr`.
    """
    most = max(float(truth.max()), 1e-12)
    return psnr(_mu_law(light, most), _mu_law(truth, most), mask)


def _mu_law(light: np.ndarray, most: float) -> np.ndarray:
    """Return the tones [0, 1] of light relative to the value `most`."""
    return np.log1p(_MU * np.clip(light.astype(np.float64) / most, 0, 1)) / np.log1p(_MU)


def psnr_of(error: float) -> float:
    """Return the PSNR of a mean squared error, dB; infinite for 0."""
    return float(-10 * np.log10(error)) if error != 0 else float("inf")


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the structural similarity (Wang et al. 2004) of the window around each pixel for which
    it fits, [H - 10, W - 10], in [-1, 1] and 1 for equal windows.

    The window is an 11x11 Gaussian of sigma 1.5, the moments are the population's, and channels are
    averaged.

    Args:
        image: [H, W, 3] or [H, W], both sides at least 11 pixels.
        truth: likewise.

    Raises:
        ValueError: the sizes differ.
    """
    image, truth = unit_pair("ssim_map", image, truth)
    x = _blur(image)
    y = _blur(truth)
    var_x = _blur(image**2) - x**2
    var_y = _blur(truth**2) - y**2
    covariance = _blur(image * truth) - x * y
    similarity = (2 * x * y + C1) * (2 * covariance + C2)
    similarity /= (x**2 + y**2 + C1) * (var_x + var_y + C2)
    return similarity.reshape(*similarity.shape[:2], -1).mean(-1)


def delta_e_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the colour difference CIE dE2000 per pixel [H, W], by colour-science; a value of about
    1 is just visible.

    Colours are decoded from sRGB and compared under its white point, D65. Values outside [0, 1] are
    clipped, as on a display.

    Args:
        image: [H, W, 3].
        truth: likewise.

    Raises:
        ValueError: the sizes differ.
    """
    # The import takes a second, for which other commands should not wait.
    from colour import XYZ_to_Lab
    from colour.difference import delta_E_CIE2000
    from colour.models import RGB_COLOURSPACE_sRGB

    a, b = np.clip(unit_pair("delta_e_map", image, truth), 0, 1)

    def lab(colours: np.ndarray) -> np.ndarray:
        xyz = decode_light(colours) @ RGB_COLOURSPACE_sRGB.matrix_RGB_to_XYZ.T
        return XYZ_to_Lab(xyz, RGB_COLOURSPACE_sRGB.whitepoint)

    def rows(start: int) -> np.ndarray:
        band = slice(start, start + _ROWS)
        return delta_E_CIE2000(lab(a[band]), lab(b[band]))

    # NumPy alone uses one core.
    return np.concatenate(map_in_threads(rows, range(0, len(a), _ROWS)))


def endpoint_error(motion: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean length of motion - truth in pixels.

    Args:
        motion: [H, W, 2] in pixels.
        truth: likewise, with the same sign and on the same grid.
        mask: [H, W] bool, the pixels that count; the result is NaN if there are none.

    Raises:
        ValueError: the sizes differ.
    """
    _check("endpoint_error", motion, truth, mask)
    return mean_over(np.linalg.norm(np.asarray(motion, np.float64) - truth, axis=-1), mask)


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    """Return the intersection of two bool masks [H, W] over their union; NaN if both are empty."""
    union = np.count_nonzero(mask | truth)
    return np.count_nonzero(mask & truth) / union if union else float("nan")


def mean_over(values: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean of a map [h, w, ...] over `mask` [H, W], or over all pixels; NaN if there are
    none.

    A map that is smaller than the mask is centred in it, like the map of `ssim_map`.
    """
    if mask is not None:
        height, width = values.shape[:2]
        top = (mask.shape[0] - height) // 2
        left = (mask.shape[1] - width) // 2
        values = values[mask[top : top + height, left : left + width]]
    return float(values.mean()) if values.size else float("nan")


def _blur(image: np.ndarray) -> np.ndarray:
    """Return the average over the Gaussian window wherever it fits, [H - 10, W - 10, ...]."""
    half = WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / SIGMA) ** 2)
    weights /= weights.sum()
    rows = correlate1d(image, weights, axis=0)[half:-half]
    return correlate1d(rows, weights, axis=1)[:, half:-half]


def unit_pair(
    name: str, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return two images of one size in float64, bytes scaled to [0, 1].

    Raises:
        ValueError: the sizes differ or the mask does not match; the message begins with `name`.
    """
    _check(name, image, truth, mask)
    return unit_values(np.asarray(image)), unit_values(np.asarray(truth))


def _check(name: str, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> None:
    shape = np.shape(image)
    if shape != np.shape(truth):
        raise ValueError(
            f"{name}(): both images must have one size, got {shape} and {np.shape(truth)}; resize "
            "one first."
        )
    if mask is not None:
        check_mask(f"{name}()", mask, *shape[:2])


class StillVariation:
    """Masked total variation of a view (mTV): 100 mean |I_t - I_{t-1}| over the static pixels.

    One mask serves the whole clip, as in the paper: pixels in which nothing moves in any frame. A
    frozen view has a variation of 0 and the recording's own variation is its noise, so both are
    reported. A mask computed from the recording itself favours the recording slightly: it selects
    the pixels that change least there.

    Args:
        valid: valid pixels [H, W], bool; None for all.
        false_alarms: share of the frames in which a pixel may be marked as moving and still count
            as static: 0 for true masks, more for masks computed from a noisy recording.
    """

    def __init__(self, valid: np.ndarray | None = None, false_alarms: float = 0) -> None:
        self._valid = valid
        self._false_alarms = false_alarms
        self._frames = 0
        self._last: np.ndarray | None = None  # rendered and recorded image [2, H, W, 3]
        self._sums = np.zeros((2, 1, 1))  # of the changes of both
        self._motion_counts = np.zeros((1, 1), int)

    def add(self, image: np.ndarray, recorded: np.ndarray, moving: np.ndarray | None) -> None:
        """Add the next frame: rendered and recorded image [H, W, 3], and the mask of moving pixels
        [H, W] bool; None: none.
        """
        pair = np.stack(unit_pair("StillVariation.add", image, recorded, moving))
        self._motion_counts = self._motion_counts + (0 if moving is None else moving)
        self._frames += 1
        if self._last is not None:
            self._sums = self._sums + np.abs(pair - self._last).mean(-1)
        self._last = pair

    def result(self) -> VariationScores:
        """Return the mTV of I and of I', and the mask's share of the view; NaN without two frames
        or a static pixel.
        """
        if self._frames < 2:
            return VariationScores()
        valid = valid_pixels(self._valid, self._sums.shape[1:])
        still = (self._motion_counts <= self._false_alarms * self._frames) & valid
        render = 100 * mean_over(self._sums[0], still) / (self._frames - 1)
        recorded = 100 * mean_over(self._sums[1], still) / (self._frames - 1)
        return VariationScores(render, recorded, float(still.sum() / max(valid.sum(), 1)))


# Not `morgs_mi.method.change.change_mask`, with which the fit selects its work. The score ignores a
# change of the whole image's brightness (it subtracts the median), accepts any noise level, and
# marks changes above four standard deviations; the fit must react to such a brightness change,
# assumes static noise of at most a grey level, and marks changes above five. Sharing one definition
# would change the regions of all published scores.
def recorded_change(last_image: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the mask of pixels [H, W] in which a recording changes by more than its noise; it
    replaces a true mask.

    Changes of brightness are averaged over 5x5 pixels. The noise is estimated from their median
    absolute deviation over the image, which is robust as long as most of the image is static. A
    change above four of its standard deviations, and above one grey level, is marked. The inside of
    a uniform moving surface does not change and is not marked; a moving shadow is.

    Args:
        last_image: I'_{t-1} [H, W, 3].
        image: I'_t, likewise.
    """
    old, new = unit_pair("recorded_change", last_image, image)
    change = cv2.blur((new - old).mean(-1), (_CHANGE_WINDOW, _CHANGE_WINDOW))
    change = np.abs(change - np.median(change))
    return change > max(_SIGMAS * 1.4826 * float(np.median(change)), _GREY_LEVEL)


def slope(values: Sequence[float]) -> float:
    """Return the slope per frame of the least-squares line through a score of consecutive frames.

    NaN if fewer than two scores are known or one is infinite.
    """
    scores = np.asarray(values, float)
    frames = np.flatnonzero(~np.isnan(scores))
    if len(frames) < 2 or np.isinf(scores).any():
        return float("nan")
    time = frames - frames.mean()
    return float(time @ scores[frames] / (time @ time))
