"""Measurements of each camera's images over time: brightness, sharpness, repeated frames, flicker
of lamps.

Notation: T frames, C cameras; an image is reduced to a grey thumbnail [h, w] of display-referred
values in [0, 255], on which all but the sharpness is measured. Missing values are NaN.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.color_space import decode_light

_WIDTH = 128  # of a thumbnail, px
# Range of thumbnail values that determine a gain; darker ones are noise, brighter ones are clipped.
_DARK = 20
_BRIGHT = 240
_MIN_PIXELS = 30
# Bands of rows: a rolling shutter reads each at another phase of a lamp.
_BANDS = 6
# A repeated frame changes by less than this share of its camera's usual change, while the other
# cameras change by more than half of their usual change.
_REPEATED = 0.1
_CHANGING = 0.5
# Lamps flicker at twice the frequency of the mains, Hz.
_MAINS = (50, 60)
# Least amplitude of a flicker that is reported, and its power relative to the median over all
# frequencies.
_MIN_AMPLITUDE = 0.004
_MIN_POWER = 12.0
_MIN_FLICKER_FRAMES = 20
_MIN_PERIODS = 2


@dataclass(frozen=True)
class Signals:
    """Measurements taken while the frames of a capture are read."""

    #: Per camera float32 [T, h, w], NaN where no pixel was recorded.
    thumbs: tuple[np.ndarray, ...]
    #: Per image [T, C], octaves: log2 of the detail at the finest scale relative to the next one.
    sharpness: np.ndarray


@dataclass(frozen=True)
class Lamp:
    """Flicker of lamps in a camera's images."""

    mains: tuple[int, ...]  #: Frequencies of the mains that explain the flicker, Hz.
    alias: float  #: The frequency at which the images become brighter and darker, Hz.
    amplitude: float  #: Amplitude of the brightness, as a share.


def read_signals(
    capture: Capture, max_frames: int, progress: Callable[[int, int], None] | None = None
) -> Signals:
    """Return the measurements of the first frames; takes about 10 ms per image of 640x480, and 100
    ms of full HD.

    Args:
        capture: a capture; its images are measured in the size in which it is read.
        max_frames: number of frames at most.
        progress: called with (frames done, frames).
    """
    count = min(max_frames, capture.num_frames)
    sizes = [(_WIDTH, max(1, round(c.height * _WIDTH / c.width))) for c in capture.cameras]
    thumbs = [np.full((count, *size[::-1]), np.nan, np.float32) for size in sizes]
    sharpness = np.full((count, len(sizes)), np.nan)
    inner = [
        None if m is None else cv2.erode(m.astype(np.uint8), np.ones((9, 9))) > 0
        for m in capture.masks
    ]
    for t, frame in enumerate(capture.displayed().partial_frames(0, count)):
        for c, image in enumerate(frame.images):
            if image is None:
                continue
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
            thumbs[c][t] = cv2.resize(grey, sizes[c], interpolation=cv2.INTER_AREA)
            mask = capture.masks[c]
            if mask is not None:
                valid = cv2.resize(mask.astype(np.float32), sizes[c], interpolation=cv2.INTER_AREA)
                thumbs[c][t][valid <= 0.999] = np.nan
            sharpness[t, c] = _sharpness(grey, inner[c])
        if progress is not None:
            progress(t + 1, count)
    return Signals(tuple(thumbs), sharpness)


def brightness(signals: Signals) -> np.ndarray:
    """Return the log of the linear brightness of each band of rows, relative to its median over
    time [T, C, bands].

    It is the median over the well-exposed pixels, most of which show a static surface.
    """
    return np.stack([_brightness(thumbs) for thumbs in signals.thumbs], axis=1)


def repeated_frames(signals: Signals) -> tuple[tuple[int, ...], ...]:
    """Return per camera the frames that repeat the previous one while the other cameras' images
    change.
    """
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        # The mean or the quartile of no value is NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        steps = [
            np.nanmean(np.abs(np.diff(thumbs, axis=0)), axis=(1, 2)) for thumbs in signals.thumbs
        ]
        changes = np.stack(steps, axis=1)
        # The upper quartile is the usual change even if every second frame is repeated.
        relative = changes / np.nanpercentile(changes, 75, axis=0)
    # Motion in a view pauses gradually, so a frame before or after a repeated one has changed.
    neighbours = np.pad(relative, ((1, 1), (0, 0)), constant_values=np.nan)
    isolated = np.fmax(neighbours[:-2], neighbours[2:]) > _CHANGING
    repeats = (relative < _REPEATED) & (others_median(relative) > _CHANGING) & isolated
    return tuple(tuple((np.flatnonzero(camera) + 1).tolist()) for camera in repeats.T)


def lamp_flicker(bands: np.ndarray, fps: float) -> Lamp | None:
    """Return the flicker of lamps in one camera's `brightness` [T, bands], or None.

    A lamp flickers at 100 or 120 Hz. A camera sees this frequency at its difference from the
    nearest multiple of the frame rate. A flicker of fewer than two periods is not found. A multiple
    of the frame rate is not found, either, because each frame sees the same phase.
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
    peak = int(amplitude.argmax())
    step = fps / count
    if amplitude[peak] < _MIN_AMPLITUDE or amplitude[peak] ** 2 < _MIN_POWER * np.median(
        amplitude**2
    ):
        return None
    aliases = {mains: abs(2 * mains - fps * round(2 * mains / fps)) for mains in _MAINS}
    explaining = tuple(
        m for m, f in aliases.items() if f >= _MIN_PERIODS * step and abs(f - peak * step) <= step
    )
    if not explaining:
        return None
    alias = float(aliases[explaining[0]])
    wave = np.exp(2j * np.pi * alias / fps * times)
    return Lamp(explaining, alias, float(_rms(wave @ (bands * window))))


def known_median(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the median of the values that are not NaN; NaN, without a warning, of none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmedian(values, axis=axis)


def others_median(values: np.ndarray) -> np.ndarray:
    """Return for each camera the median of the other cameras' known values [..., C]."""
    medians = [
        known_median(np.delete(values, view, axis=-1), axis=-1) for view in range(values.shape[-1])
    ]
    return np.stack(medians, axis=-1)


def _rms(amplitudes: np.ndarray) -> np.ndarray:
    """Return the root mean square of complex amplitudes over the bands of rows, the last axis."""
    return np.sqrt((np.abs(amplitudes) ** 2).mean(axis=-1))


def _sharpness(grey: np.ndarray, mask: np.ndarray | None) -> float:
    """Return the sharpness of an image: a blur removes detail at the finest scale, a change of
    contrast at both.
    """
    blur = cv2.GaussianBlur(grey, (0, 0), 1.0)
    strong_blur = cv2.GaussianBlur(blur, (0, 0), 2.0)
    fine, coarse = (
        float(np.abs(x if mask is None else x[mask]).mean())
        for x in (grey - blur, blur - strong_blur)
    )
    return float(np.log2(fine / coarse)) if fine > 0 and coarse > 0 else float("nan")


def _brightness(thumbs: np.ndarray) -> np.ndarray:
    reference = known_median(thumbs, axis=0)
    good = (thumbs > _DARK) & (thumbs < _BRIGHT) & (reference > _DARK) & (reference < _BRIGHT)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.log(decode_light(thumbs / 255) / decode_light(reference / 255))
    ratios = np.where(good, ratios, np.nan)
    bands = [band.reshape(len(thumbs), -1) for band in np.array_split(ratios, _BANDS, axis=1)]
    columns = [
        np.where(np.isfinite(x).sum(axis=1) < _MIN_PIXELS, np.nan, known_median(x, axis=1))
        for x in bands
    ]
    return np.stack(columns, axis=1)
