"""Quality over time: the variation of static pixels and the slope of a score.

I_t is frame t of one fixed view, display-referred in [0, 1]; I'_t is the recorded frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from morgs_mi.core.checks import valid_pixels
from morgs_mi.evaluate.metrics import mean_over, unit_pair
from morgs_mi.evaluate.results import VariationScores

_WINDOW = 5
_SIGMAS = 4
_GREY_LEVEL = 1 / 255


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
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._sums: list[np.ndarray] = []
        self._motion_counts = np.zeros((1, 1), int)

    def add(self, image: np.ndarray, recorded: np.ndarray, moving: np.ndarray) -> None:
        """Add the next frame: rendered and recorded image [H, W, 3], and the mask of moving pixels
        [H, W] bool.
        """
        pair = unit_pair("StillVariation.add", image, recorded, moving)
        self._motion_counts = self._motion_counts + moving
        self._frames += 1
        if self._last is not None:
            sums = self._sums or (0, 0)
            self._sums = [
                total + np.abs(new - old).mean(-1)
                for total, new, old in zip(sums, pair, self._last, strict=True)
            ]
        self._last = pair

    def result(self) -> VariationScores:
        """Return the mTV of I and of I', and the mask's share of the view; NaN without two frames
        or a static pixel.
        """
        if self._frames < 2:
            return VariationScores()
        valid = valid_pixels(self._valid, self._motion_counts.shape)
        still = (self._motion_counts <= self._false_alarms * self._frames) & valid
        render, recorded = (
            100 * mean_over(total, still) / (self._frames - 1) for total in self._sums
        )
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
    change = cv2.blur((new - old).mean(-1), (_WINDOW, _WINDOW))
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
