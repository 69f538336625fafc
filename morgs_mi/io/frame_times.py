"""The clock of a video's frames, from their times, and the time codes of clips."""

from __future__ import annotations

import re

import numpy as np

# Deviation from a constant rate that does not count: the exposure's, in frames.
_JITTER = 0.1
# Rounding of Matroska's times, s.
_ROUNDING = 1e-3


def clock(times: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the positions of frames on a regular clock and its rate, None if the rate of the
    frames is constant.
    """
    if len(times) < 3:
        return None
    steps = np.diff(times)
    # Most frames are one period apart, and in step with the clock.
    period = float(steps[steps < 1.5 * np.median(steps)].mean())
    ticks = np.append(0, np.cumsum(np.maximum(1, np.rint(steps / period))))
    positions = (times - np.median(times - period * ticks)) / period
    if np.abs(positions - np.arange(len(times))).max() <= _JITTER + _ROUNDING / period:
        return None
    return positions, 1 / period


def true_rate(fps: float, frames: float, duration: float) -> float:
    """Return the frame rate `fps` of a header, unless the times of the frames contradict it.

    Args:
        fps: frames per second, 0 if the header does not state them.
        frames: number of frame periods between the first and the last frame.
        duration: time between the two, s.
    """
    # A header may have a rounded rate or a mean over pauses, and the time of a frame may be
    # rounded.
    difference = abs(fps * duration - frames)
    return fps if not duration or difference <= _JITTER + _ROUNDING * fps else frames / duration


def time_code_seconds(text: str, fps: float) -> float:
    """Return the time of an SMPTE time code ``hh:mm:ss:ff``, s, or NaN for another text.

    With a semicolon before the frame, two of 30 frame numbers (four of 60) are dropped in every
    minute except each tenth one, so that the time code follows the clock at 29.97 fps.

    Args:
        text: the time code.
        fps: frames per second.
    """
    match = re.fullmatch(r"(\d+):(\d+):(\d+)([:;.])(\d+)", text)
    if match is None or not fps:
        return np.nan
    hours, minutes, seconds, frame = map(int, match.group(1, 2, 3, 5))
    minutes += 60 * hours
    count = (60 * minutes + seconds) * round(fps) + frame
    if match[4] != ":":
        count -= round(fps / 15) * (minutes - minutes // 10)
    return count / fps
