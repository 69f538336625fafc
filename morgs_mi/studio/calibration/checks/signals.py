"""Measurements of each camera's images over time: brightness, sharpness, repeated frames, flicker
of lamps.

Notation: T frames, C cameras; an image is reduced to a grey thumbnail [h, w] of display-referred
values in [0, 255], on which all but the sharpness is measured. Missing values are NaN.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
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
    signals = _missing_signals(capture, count)
    masks = [(mask, _inner(mask)) for mask in capture.masks]
    for t, frame in enumerate(capture.displayed().partial_frames(0, count)):
        for c, image in enumerate(frame.images):
            if image is not None:
                _store_image(signals, (t, c), image, *masks[c])
        if progress is not None:
            progress(t + 1, count)
    return signals


def _missing_signals(capture: Capture, count: int) -> Signals:
    """Return signals of `count` frames with all values missing."""
    shapes = [(count, _thumb_height(camera), _WIDTH) for camera in capture.cameras]
    thumbs = tuple(np.full(shape, np.nan, np.float32) for shape in shapes)
    return Signals(thumbs, np.full((count, len(shapes)), np.nan))


def _thumb_height(camera: Camera) -> int:
    return max(1, round(camera.height * _WIDTH / camera.width))


def _inner(mask: np.ndarray | None) -> np.ndarray | None:
    """Return the mask without the pixels near its edges."""
    return None if mask is None else cv2.erode(mask.astype(np.uint8), np.ones((9, 9))) > 0


def _store_image(
    signals: Signals,
    place: tuple[int, int],
    image: np.ndarray,
    mask: np.ndarray | None,
    inner: np.ndarray | None,
) -> None:
    """Store the measurements of an image at its frame and camera."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    t, c = place
    _store_thumb(signals.thumbs[c][t], grey, mask)
    signals.sharpness[place] = _sharpness(grey, inner)


def _store_thumb(thumb: np.ndarray, grey: np.ndarray, mask: np.ndarray | None) -> None:
    """Store the reduced image in `thumb`, NaN where a pixel is not valid."""
    reduced = partial(cv2.resize, dsize=thumb.shape[::-1], interpolation=cv2.INTER_AREA)
    thumb[:] = reduced(grey)
    if mask is not None:
        thumb[reduced(mask.astype(np.float32)) <= 0.999] = np.nan


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
    relative = _relative_changes(signals.thumbs)
    others_change = others_median(relative) > _CHANGING
    repeats = (relative < _REPEATED) & others_change & _are_isolated(relative)
    return tuple(tuple((np.flatnonzero(camera) + 1).tolist()) for camera in repeats.T)


def _relative_changes(thumbs: Sequence[np.ndarray]) -> np.ndarray:
    """Return the change from frame to frame relative to each camera's usual change [T - 1, C]."""
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        # The mean or the quartile of no value is NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        changes = np.stack([_changes(camera) for camera in thumbs], axis=1)
        # The upper quartile is the usual change even if every second frame is repeated.
        return changes / np.nanpercentile(changes, 75, axis=0)


def _changes(thumbs: np.ndarray) -> np.ndarray:
    """Return the mean change of a camera's pixels from frame to frame [T - 1]."""
    return np.nanmean(np.abs(np.diff(thumbs, axis=0)), axis=(1, 2))


def _are_isolated(relative: np.ndarray) -> np.ndarray:
    """Return the mask [T - 1, C] of steps with a change before or after them."""
    # Motion in a view pauses gradually, so a frame before or after a repeated one has changed.
    neighbours = np.pad(relative, ((1, 1), (0, 0)), constant_values=np.nan)
    return np.fmax(neighbours[:-2], neighbours[2:]) > _CHANGING


def lamp_flicker(bands: np.ndarray, fps: float) -> Lamp | None:
    """Return the flicker of lamps in one camera's `brightness` [T, bands], or None.

    A lamp flickers at 100 or 120 Hz. A camera sees this frequency at its difference from the
    nearest multiple of the frame rate. A flicker of fewer than two periods is not found. A multiple
    of the frame rate is not found, either, because each frame sees the same phase.
    """
    count = len(bands)
    if count < _MIN_FLICKER_FRAMES or not np.isfinite(bands).any():
        return None
    bands = _without_trend(bands) * _window(count)
    aliases = _aliases(_rms(np.fft.rfft(bands, axis=0)), fps, fps / count)
    if not aliases:
        return None
    alias = float(next(iter(aliases.values())))
    wave = np.exp(2j * np.pi * alias / fps * _centred_times(count))
    return Lamp(tuple(aliases), alias, float(_rms(wave @ bands)))


def _centred_times(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


def _without_trend(bands: np.ndarray) -> np.ndarray:
    """Return the bands over time [T, bands] without their median and their linear trend."""
    times = _centred_times(len(bands))
    bands = np.where(np.isfinite(bands), bands, 0)
    bands = bands - np.median(bands, axis=0)
    return bands - times[:, None] * (times @ bands) / (times @ times)


def _window(count: int) -> np.ndarray:
    """Return Hann's window [count, 1], with which an oscillation's sum is its amplitude."""
    window = np.hanning(count + 2)[1:-1, None]
    return 2 * window / window.sum()


def _has_peak(amplitude: np.ndarray) -> bool:
    """Return whether a spectrum has one strong frequency."""
    peak = amplitude.max()
    return not (peak < _MIN_AMPLITUDE or peak**2 < _MIN_POWER * np.median(amplitude**2))


def _aliases(amplitude: np.ndarray, fps: float, step: float) -> dict[int, float]:
    """Return the frequency at which a camera sees a lamp, by the frequencies of mains that explain
    the peak of a spectrum.

    Args:
        amplitude: the spectrum.
        fps: frames per second.
        step: between the frequencies of the spectrum, Hz.
    """
    if not _has_peak(amplitude):
        return {}
    peak = int(amplitude.argmax()) * step
    aliases = {mains: abs(2 * mains - fps * round(2 * mains / fps)) for mains in _MAINS}
    return {
        mains: alias
        for mains, alias in aliases.items()
        if alias >= _MIN_PERIODS * step and abs(alias - peak) <= step
    }


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
    fine = _mean_size(grey - blur, mask)
    coarse = _mean_size(blur - cv2.GaussianBlur(blur, (0, 0), 2.0), mask)
    return float(np.log2(fine / coarse)) if fine > 0 and coarse > 0 else float("nan")


def _mean_size(values: np.ndarray, mask: np.ndarray | None) -> float:
    return float(np.abs(values if mask is None else values[mask]).mean())


def _brightness(thumbs: np.ndarray) -> np.ndarray:
    bands = np.array_split(_log_ratios(thumbs), _BANDS, axis=1)
    return np.stack([_band_brightness(band.reshape(len(thumbs), -1)) for band in bands], axis=1)


def _log_ratios(thumbs: np.ndarray) -> np.ndarray:
    """Return the log ratios of linear values to their medians over time [T, h, w], NaN where a
    value is too dark or too bright.
    """
    reference = known_median(thumbs, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.log(decode_light(thumbs / 255) / decode_light(reference / 255))
    return np.where(_are_exposed(thumbs) & _are_exposed(reference), ratios, np.nan)


def _are_exposed(values: np.ndarray) -> np.ndarray:
    return (values > _DARK) & (values < _BRIGHT)


def _band_brightness(ratios: np.ndarray) -> np.ndarray:
    """Return the median [T] of the ratios [T, pixels] of a band, NaN with too few of them."""
    is_poor = np.isfinite(ratios).sum(axis=1) < _MIN_PIXELS
    return np.where(is_poor, np.nan, known_median(ratios, axis=1))
