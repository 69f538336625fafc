"""What changes over time and should not: pixels that stand still, and a score that ought to hold.

I_t is frame t of one fixed view, display-referred in [0, 1]; I'_t is what was recorded.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from morgs_mi.evaluate.metrics import mean_over, unit_pair

__all__ = ["StillVariation", "recorded_change", "slope"]

_WINDOW = 5
_SIGMAS = 4
_GREY_LEVEL = 1 / 255


class StillVariation:
    """Masked total variation of a view (mTV): 100 mean |I_t - I_{t-1}| over the pixels that stand still.

    The mask is one for the clip, as in the paper: pixels where nothing moved in any frame. A view that is frozen
    has a variation of 0, and a recording's own is its noise, so the two are told side by side. A mask that is told from
    the recording itself favours the recording a little: it is made of what changed least there.

    Args:
        valid: [H, W] bool, pixels that may count; None for all.
        false_alarms: share of the frames in which a pixel may be said to move and still count as standing still:
            0 for true masks, more for those told from a noisy recording.
    """

    def __init__(self, valid: np.ndarray | None = None, false_alarms: float = 0) -> None:
        self._valid, self._false_alarms, self._frames = valid, false_alarms, 0
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._sums: list[np.ndarray] = []
        self._moved = np.zeros((1, 1), int)

    def add(self, image: np.ndarray, recorded: np.ndarray, moving: np.ndarray) -> None:
        """Take in the next frame: rendered and recorded picture [H, W, 3], and where something moves [H, W] bool."""
        pair = unit_pair("StillVariation.add", image, recorded, moving)
        self._moved = self._moved + moving
        self._frames += 1
        if self._last is not None:
            changes = [np.abs(new - old).mean(-1) for new, old in zip(pair, self._last, strict=True)]
            self._sums = [a + b for a, b in zip(self._sums, changes, strict=True)] if self._sums else changes
        self._last = pair

    def result(self) -> dict[str, float]:
        """Return ``render`` and ``input``, the mTV of I and of I', and ``still_share``, the mask's share of the view.

        Without two frames or a still pixel they are NaN.
        """
        if self._frames < 2:
            return dict.fromkeys(("render", "input", "still_share"), float("nan"))
        valid = np.ones(self._moved.shape, bool) if self._valid is None else self._valid
        still = (self._moved <= self._false_alarms * self._frames) & valid
        render, recorded = (100 * mean_over(total, still) / (self._frames - 1) for total in self._sums)
        return {"render": render, "input": recorded, "still_share": float(still.sum() / max(valid.sum(), 1))}


def recorded_change(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return where a recording changes by more than its noise [H, W], bool: what stands in for a missing true mask.

    Changes of brightness are averaged over 5x5 pixels. Noise is told from their median absolute deviation over the
    picture, which holds while most of it stands still; what exceeds four of its standard deviations, and one grey
    level, has changed. The inside of a plain moving surface does not change and is not found; a moving shadow is.

    Args:
        before: I'_{t-1} [H, W, 3].
        after: I'_t, likewise.
    """
    old, new = unit_pair("recorded_change", before, after)
    change = cv2.blur((new - old).mean(-1), (_WINDOW, _WINDOW))
    change = np.abs(change - np.median(change))
    return change > max(_SIGMAS * 1.4826 * float(np.median(change)), _GREY_LEVEL)


def slope(values: Sequence[float]) -> float:
    """Return the slope per frame of the least-squares line through a score of consecutive frames.

    NaN where fewer than two frames have one, or one is infinite.
    """
    scores = np.asarray(values, float)
    known = np.flatnonzero(~np.isnan(scores))
    if len(known) < 2 or np.isinf(scores).any():
        return float("nan")
    time = known - known.mean()
    return float(time @ scores[known] / (time @ time))
