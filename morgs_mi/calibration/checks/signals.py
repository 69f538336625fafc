"""Measurements of each camera's images over time: brightness, sharpness, repeated frames, flicker of lamps.

Notation: T frames, C cameras; an image is reduced to a grey thumbnail [h, w] of display-referred values in [0, 255], on
which all but the sharpness is measured. Missing values are NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.color_space import srgb_to_linear

__all__ = [
    "Lamp",
    "Signals",
    "brightness",
    "known_median",
    "lamp_flicker",
    "read_signals",
    "repeated_frames",
    "shrunk_mask",
]

_WIDTH = 128  # of a thumbnail, px
# Range of thumbnail values that determine a gain; darker ones are noise, brighter ones are clipped.
_DARK, _BRIGHT, _MIN_PIXELS = 20, 240, 30
# Bands of rows: a rolling shutter reads each at another phase of a lamp.
_BANDS = 6
# A repeated frame changes by less than this share of its camera's usual change, while the other cameras change by more
# than half of their usual change.
_REPEATED, _CHANGING = 0.1, 0.5
# Lamps flicker at twice the frequency of the mains, Hz.
_MAINS = (50, 60)
# Least amplitude of a flicker that is reported, and its power relative to the median over all frequencies.
_MIN_AMPLITUDE, _MIN_POWER = 0.004, 12.0
_MIN_FLICKER_FRAMES, _MIN_PERIODS = 20, 2


@dataclass(frozen=True)
class Signals:
    """Measurements taken while the frames of a capture are read.

    Attributes:
        thumbs: per camera float32 [T, h, w], NaN where no pixel was recorded.
        sharpness: per image [T, C], octaves: log2 of the detail at the finest scale relative to the next one.
    """

    thumbs: tuple[np.ndarray, ...]
    sharpness: np.ndarray


@dataclass(frozen=True)
class Lamp:
    """Flicker of lamps in a camera's images.

    Attributes:
        mains: frequencies of the mains that explain the flicker, Hz.
        alias: the frequency at which the images become brighter and darker, Hz.
        amplitude: amplitude of the brightness, as a share.
    """

    mains: tuple[int, ...]
    alias: float
    amplitude: float


def read_signals(capture: Capture, max_frames: int, progress: Callable[[int, int], None] | None = None) -> Signals:
    """Return the measurements of the first frames; takes about 10 ms per image of 640x480, and 100 ms of full HD.

    Args:
        capture: a capture; its images are measured in the size in which it is read.
        max_frames: number of frames at most.
        progress: called with (frames done, frames).
    """
    count = min(max_frames, capture.num_frames)
    sizes = [(_WIDTH, max(1, round(c.height * _WIDTH / c.width))) for c in capture.cameras]
    thumbs = [np.full((count, *size[::-1]), np.nan, np.float32) for size in sizes]
    sharpness = np.full((count, len(sizes)), np.nan)
    inner = [None if m is None else cv2.erode(m.astype(np.uint8), np.ones((9, 9))) > 0 for m in capture.masks]
    hidden = [None if m is None else ~shrunk_mask(m, size) for m, size in zip(capture.masks, sizes, strict=True)]
    for t, frame in enumerate(capture.partial_frames(0, count)):
        for c, image in enumerate(frame.images):
            if image is None:
                continue
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
            thumbs[c][t] = cv2.resize(grey, sizes[c], interpolation=cv2.INTER_AREA)
            if hidden[c] is not None:
                thumbs[c][t][hidden[c]] = np.nan
            sharpness[t, c] = _sharpness(grey, inner[c])
        if progress is not None:
            progress(t + 1, count)
    return Signals(tuple(thumbs), sharpness)


def brightness(signals: Signals) -> np.ndarray:
    """Return the log of the linear brightness of each band of rows, relative to its median over time [T, C, bands].

    It is the median over the well-exposed pixels, most of which show a static surface.
    """
    found = [_brightness(thumbs) for thumbs in signals.thumbs]
    return np.stack(found, axis=1)


def repeated_frames(signals: Signals) -> tuple[tuple[int, ...], ...]:
    """Return per camera the frames that repeat the previous one while the other cameras' images change."""
    changes = np.stack([_mean_change(thumbs) for thumbs in signals.thumbs], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The upper quartile is the usual change even if every second frame is repeated.
        usual = np.nanpercentile(changes, 75, axis=0) if len(changes) else np.zeros(len(signals.thumbs))
        relative = changes / usual
    found = []
    for camera, own in enumerate(relative.T):
        others = np.delete(relative, camera, axis=1)
        moving = known_median(others, axis=1) > _CHANGING
        # Motion in a view pauses gradually.
        before, after = np.append(np.nan, own[:-1]), np.append(own[1:], np.nan)
        isolated = np.fmax(before, after) > _CHANGING
        found.append(tuple((np.flatnonzero((own < _REPEATED) & moving & isolated) + 1).tolist()))
    return tuple(found)


def lamp_flicker(bands: np.ndarray, fps: float) -> Lamp | None:
    """Return the flicker of lamps in one camera's `brightness` [T, bands], or None.

    A lamp flickers at 100 or 120 Hz. A camera sees this frequency at its difference from the nearest multiple of the
    frame rate. A flicker of fewer than two periods is not found. A multiple of the frame rate is not found, either,
    because each frame sees the same phase.
    """
    count = len(bands)
    if count < _MIN_FLICKER_FRAMES or not np.isfinite(bands).any():
        return None
    times = np.arange(count) - (count - 1) / 2
    bands = np.where(np.isfinite(bands), bands, 0)
    bands = bands - np.median(bands, axis=0)
    bands = bands - times[:, None] * (times @ bands) / (times @ times)
    window = np.hanning(count + 2)[1:-1, None]
    window = 2 * window / window.sum()
    amplitude = _rms(np.fft.rfft(bands * window, axis=0))
    peak, step = int(amplitude.argmax()), fps / count
    if amplitude[peak] < _MIN_AMPLITUDE or amplitude[peak] ** 2 < _MIN_POWER * np.median(amplitude**2):
        return None
    aliases = {mains: abs(2 * mains - fps * round(2 * mains / fps)) for mains in _MAINS}
    explaining = tuple(m for m, f in aliases.items() if f >= _MIN_PERIODS * step and abs(f - peak * step) <= step)
    if not explaining:
        return None
    alias = float(aliases[explaining[0]])
    wave = np.exp(2j * np.pi * alias / fps * times)
    return Lamp(explaining, alias, float(_rms(wave @ (bands * window))))


def known_median(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the median of the values that are not NaN; NaN, without a warning, where all are NaN."""
    empty = np.isnan(values).all(axis=axis)
    if empty.all():
        return np.full(empty.shape, np.nan)
    found = np.nanmedian(np.where(np.expand_dims(empty, axis), 0, values), axis=axis)
    return np.where(empty, np.nan, found)


def _rms(amplitudes: np.ndarray) -> np.ndarray:
    """Return the root mean square of complex amplitudes over the bands of rows, the last axis."""
    return np.sqrt((np.abs(amplitudes) ** 2).mean(axis=-1))


def shrunk_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels of a thumbnail that contain only valid pixels."""
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999


def _sharpness(grey: np.ndarray, mask: np.ndarray | None) -> float:
    """Return the sharpness of an image: a blur removes detail at the finest scale, a change of contrast at both."""
    once = cv2.GaussianBlur(grey, (0, 0), 1.0)
    twice = cv2.GaussianBlur(once, (0, 0), 2.0)
    fine, coarse = (float(np.abs(x if mask is None else x[mask]).mean()) for x in (grey - once, once - twice))
    return float(np.log2(fine / coarse)) if fine > 0 and coarse > 0 else float("nan")


def _brightness(thumbs: np.ndarray) -> np.ndarray:
    reference = known_median(thumbs, axis=0)
    good = (thumbs > _DARK) & (thumbs < _BRIGHT) & (reference > _DARK) & (reference < _BRIGHT)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.log(srgb_to_linear(thumbs / 255) / srgb_to_linear(reference / 255))
    ratios = np.where(good, ratios, np.nan)
    found = np.full((len(thumbs), _BANDS), np.nan)
    for band, rows in enumerate(np.array_split(np.arange(thumbs.shape[1]), _BANDS)):
        values = ratios[:, rows].reshape(len(thumbs), -1)
        enough = np.isfinite(values).sum(axis=1) >= _MIN_PIXELS
        found[enough, band] = known_median(values[enough], axis=1)
    return found


def _mean_change(thumbs: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference of successive thumbnails [T - 1]."""
    steps = np.abs(np.diff(thumbs, axis=0))
    valid = np.isfinite(steps).sum(axis=(1, 2))
    return np.where(valid, np.nansum(steps, axis=(1, 2)) / np.maximum(valid, 1), np.nan)
