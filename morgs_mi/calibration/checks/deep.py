"""Check of a whole recording: cameras that differ from the others in time, exposure, sharpness or position.

`rig_check` checks the poses on the first frame; this module reads many frames. A finding is a sentence with numbers and
advice. The limits are far above the values of clips without faults.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from morgs_mi.calibration.checks.rig_check import RigCheck, SharedFeatures
from morgs_mi.calibration.checks.signals import (
    Lamp,
    Signals,
    brightness,
    known_median,
    lamp_flicker,
    repeated_frames,
    shrunk_mask,
)
from morgs_mi.calibration.checks.synchrony import consensus, time_offsets
from morgs_mi.capture.capture import Capture
from morgs_mi.capture.color_correction import matched_colors
from morgs_mi.capture.features import detect, match_views
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import overlaps

__all__ = ["MAX_FRAMES", "DeepCheck", "Finding", "check_deep", "check_exposures"]

# Largest number of frames that are read: the start of a longer recording shows its faults.
MAX_FRAMES = 120
# px, and multiple of the rig's median, above which a reprojection error is a finding.
_ERROR, _TIMES_ERROR = 0.7, 3.0
# Frames. A time offset is a finding if it is nearer to a whole frame than to zero, by more than its error.
_OFFSET, _OFFSET_CHANGE, _MIN_HALF = 0.65, 0.75, 24
# Differences of log gains: about 10 % of exposure, and 5 % of one channel against the mean of all.
_EXPOSURE, _BALANCE, _MIN_SAMPLES = 0.1, 0.05, 16
_CORRECTION = "; fit corrects it (not with --exposure off)"
# Quick check of the exposures: width of the reduced images, px, and number of near views that each is matched with.
_QUICK_WIDTH, _QUICK_NEIGHBOURS = 480, 3
# Error of a median log ratio that no number of points removes, because surfaces look different from two sides.
_LOG_ERROR = 0.02
# Threshold on the range of the log brightness over time, about 8 %: people walking through a room cause up to 5 %.
_VARIATION = 0.08
# Octaves by which an image is less sharp than the images of the rig, and than the others of its camera.
_BLUR, _BLURRED_FRAME, _SPREADS = 1.0, 0.5, 6.0
# Share of a camera's image that the camera with the largest overlap sees.
_OVERLAP = 0.3
_MAX_LISTED = 6


@dataclass(frozen=True)
class Finding:
    """A fault of a recording.

    Attributes:
        question: name of the check: error, time, exposure, variation, flicker, blur, repeats or overlap.
        cameras: names of the cameras that it concerns.
        sentence: numbers and advice.
    """

    question: str
    cameras: tuple[str, ...]
    sentence: str


@dataclass(frozen=True)
class DeepCheck:
    """Result of checking a recording; missing measurements are NaN.

    Attributes:
        names: names of the C cameras.
        frames: number T of frames that were read.
        fps: frames per second.
        given: time offset with which each camera was read, frames.
        errors: median reprojection error of each camera [C], px.
        offsets: time offset of each camera from the median [C], frames.
        halves: the same in the first and the last half of the frames [2, C].
        gains: log gain of each camera's channels in linear light, relative to the median [C, 3].
        brightness: log brightness of each camera over time, relative to its median [T, C].
        sharpness: per image [T, C], octaves.
        repeated: per camera the frames that repeat the previous one.
        lamps: per camera the flicker of lamps, or None.
        overlaps: share of each camera's image that each other camera sees [C, C].
        findings: faults.
    """

    names: tuple[str, ...]
    frames: int
    fps: float
    given: tuple[float, ...]
    errors: np.ndarray
    offsets: np.ndarray
    halves: np.ndarray
    gains: np.ndarray
    brightness: np.ndarray
    sharpness: np.ndarray
    repeated: tuple[tuple[int, ...], ...]
    lamps: tuple[Lamp | None, ...]
    overlaps: np.ndarray
    findings: tuple[Finding, ...] = ()

    @property
    def unmeasured(self) -> str:
        """The missing measurements and their cameras, in a sentence; empty if none is missing."""
        values = {"time offsets": self.offsets, "exposure against the other cameras": self.gains.mean(axis=1)}
        missing = {what: [self.names[view] for view in np.flatnonzero(np.isnan(v))] for what, v in values.items()}
        parts = [f"{what} of {_listed(names, len(self.names))}" for what, names in missing.items() if names]
        return f"Not measured, without enough common motion or matches: {'; '.join(parts)}." if parts else ""

    def as_dict(self) -> dict[str, Any]:
        """Return all measurements and findings in JSON types."""
        return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in asdict(self).items()}


def check_deep(capture: Capture, shared: SharedFeatures, rig: RigCheck, signals: Signals) -> DeepCheck:
    """Return the measurements and the faults of a recording.

    Args:
        capture: at its recorded size.
        shared: features of its first frame.
        rig: result of checking the poses with these features.
        signals: measurements of its frames.
    """
    bands = brightness(signals)
    half = len(bands) // 2
    parts = ([t[:half] for t in signals.thumbs], [t[half:] for t in signals.thumbs]) if half >= _MIN_HALF else ()
    measured = DeepCheck(
        names=capture.names,
        frames=len(bands),
        fps=capture.fps,
        given=tuple(capture.reading.offset.get(name, 0) for name in capture.names),
        errors=np.array([camera.error for camera in rig.cameras]),
        offsets=time_offsets(capture.cameras, signals.thumbs),
        halves=np.array([time_offsets(capture.cameras, part) for part in parts]).reshape(-1, len(capture.cameras)),
        gains=_gains(capture.cameras, next(capture.partial_frames(0, 1)).images, shared),
        brightness=known_median(bands, axis=2),
        sharpness=signals.sharpness,
        repeated=repeated_frames(signals),
        lamps=tuple(lamp_flicker(bands[:, c], capture.fps) for c in range(len(capture.cameras))),
        overlaps=overlaps(capture.cameras, capture.points),
    )
    findings = [_finding(capture.names, q, found) for q, find in _QUESTIONS.items() for found in find(measured)]
    return replace(measured, findings=tuple(findings))


def check_exposures(capture: Capture, shared: SharedFeatures | None = None) -> list[Finding]:
    """Return a finding for each camera with a different exposure or white balance in the first frame.

    Args:
        capture: a capture.
        shared: features of its first frame in its size; None: features of reduced images, in about 0.3 s per view.
    """
    capture = _reduced(capture) if shared is None else capture
    images = next(capture.partial_frames(0, 1)).images
    if shared is None:
        features = tuple(detect(image, mask) for image, mask in zip(images, capture.masks, strict=True))
        shared = SharedFeatures(features, tuple(match_views(features, capture.cameras, _QUICK_NEIGHBOURS)))
    gains = _gains(capture.cameras, images, shared)
    return [_finding(capture.names, "exposure", found) for found in _exposures(gains)]


def _reduced(capture: Capture) -> Capture:
    """Return a capture with images that are at most `_QUICK_WIDTH` wide."""
    sizes = [(min(c.width, _QUICK_WIDTH), round(c.height * min(1, _QUICK_WIDTH / c.width))) for c in capture.cameras]
    cameras = tuple(camera.resized(*size) for camera, size in zip(capture.cameras, sizes, strict=True))
    masks = tuple(None if m is None else shrunk_mask(m, s) for m, s in zip(capture.masks, sizes, strict=True))
    return replace(capture, cameras=cameras, masks=masks)


def _gains(cameras: Sequence[Camera], images: Sequence[np.ndarray | None], shared: SharedFeatures) -> np.ndarray:
    """Return the log gains of all cameras [C, 3] that explain the colours of points in two views."""
    pairs, colors = matched_colors(cameras, images, shared.features, shared.matches)
    pairs = [pair for pair in pairs if len(pair.features) >= _MIN_SAMPLES]
    ratios = []
    for pair in pairs:
        a, b = (colors[view][pair.features[:, k]] for k, view in enumerate(pair.views))
        ratios.append(np.log(b / a))
    middles = np.array([np.median(ratio, axis=0) for ratio in ratios]).reshape(-1, 3)
    deviations = np.array([np.abs(r - m).mean() / np.sqrt(len(r)) for r, m in zip(ratios, middles, strict=True)])
    views, weights = np.array([pair.views for pair in pairs]).reshape(-1, 2), 1 / (deviations**2 + _LOG_ERROR**2)
    return np.stack([consensus(len(colors), views, channel, weights) for channel in middles.T], axis=1)


# The cameras that a finding concerns, and their fault.
_Found = tuple[Sequence[int], str]


def _finding(names: Sequence[str], question: str, found: _Found) -> Finding:
    views, text = found
    cameras = tuple(names[view] for view in views)
    return Finding(question, cameras, f"{', '.join(cameras)} {text}.")


def _errors(check: DeepCheck) -> Iterator[_Found]:
    for view, error in enumerate(check.errors):
        usual = _usual(np.delete(check.errors, view))
        if np.isfinite(error) and error > max(_ERROR, _TIMES_ERROR * usual):
            yield (
                [view],
                f"has a reprojection error of {error:.2f} px, the others {usual:.2f} px: check its lens model and "
                "focal length, or calibrate again (morgs-mi calibrate)",
            )


def _times(check: DeepCheck) -> Iterator[_Found]:
    for view, offset in enumerate(check.offsets.tolist()):
        halves = check.halves[:, view]
        if len(halves) and abs(change := halves[1] - halves[0]) >= _OFFSET_CHANGE:
            yield (
                [view],
                f"moves {abs(change):.1f} frames {'ahead of' if change > 0 else 'behind'} the other cameras during "
                f"the first {check.frames} frames: frames were lost or its clock runs at another rate; copy the clip "
                "again, or convert it with its true time stamps",
            )
        elif abs(offset) >= _OFFSET and not (np.abs(halves - offset) > _OFFSET_CHANGE).any():
            side, milliseconds = "ahead of" if offset > 0 else "behind", 1e3 / check.fps * abs(offset)
            yield (
                [view],
                f"is {abs(offset):.1f} frames ({milliseconds:.0f} ms) {side} the other cameras: use --offset "
                f"{check.names[view]} {check.given[view] - round(offset)}, or record with synchronised cameras",
            )


def _exposures(gains: np.ndarray) -> Iterator[_Found]:
    """Yield the cameras with a different exposure or white balance; `gains` are log gains per channel [C, 3]."""
    for view, (own, mean) in enumerate(zip(gains, gains.mean(axis=1), strict=True)):
        if abs(mean) > _EXPOSURE:
            amount = f"{100 * abs(np.expm1(mean)):.0f} % {'brighter' if mean > 0 else 'darker'}"
            yield [view], f"is {amount} than the other cameras: set the same exposure and gain{_CORRECTION}"
        if np.abs(own - mean).max() > _BALANCE:
            channels = ", ".join(f"{n} {100 * np.expm1(g - mean):+.0f} %" for n, g in zip("RGB", own, strict=True))
            what = f"has another white balance than the other cameras ({channels}): set a fixed one"
            yield [view], f"{what}{_CORRECTION}"


def _flicker(check: DeepCheck) -> Iterator[_Found]:
    for mains in sorted({lamp.mains for lamp in check.lamps if lamp}):
        lamps = {view: lamp for view, lamp in enumerate(check.lamps) if lamp and lamp.mains == mains}
        amplitude, alias = max((lamp.amplitude, lamp.alias) for lamp in lamps.values())
        exposure = " or ".join(f"1/{2 * frequency}" for frequency in mains)
        yield (
            list(lamps),
            f"flicker by {100 * amplitude:.1f} % at {alias:.1f} Hz, as lamps on {' or '.join(map(str, mains))} Hz "
            f"mains do: expose for a multiple of {exposure} s, or use lamps without flicker; fit corrects "
            "what the cameras do not have in common",
        )


def _variations(check: DeepCheck) -> Iterator[_Found]:
    common = known_median(check.brightness, axis=1)[:, None]
    span, rest = _span(common)[0], _usual(_span(check.brightness - common))
    # The range of a flicker is twice its amplitude; twice that range has another cause as well.
    limits = np.array([max(_VARIATION, 4 * lamp.amplitude if lamp else 0) for lamp in check.lamps])
    lit = len(check.names) > 2 and span > limits.max() and rest < 0.5 * span
    if lit:
        yield (
            range(len(check.names)),
            f"change their brightness alike, by {100 * np.expm1(span):.0f} % over time: the light of the scene "
            "changes; use constant light",
        )
    for view, values in enumerate((check.brightness - common if lit else check.brightness).T):
        known = values[np.isfinite(values)]
        if len(known) and (own := np.ptp(known)) > limits[view]:
            jump = np.abs(np.diff(known)).max()
            yield (
                [view],
                f"changes its brightness by {100 * np.expm1(own):.0f} % over time, up to {100 * np.expm1(jump):.0f} % "
                "from frame to frame: fix the exposure" + _CORRECTION,
            )


def _span(values: np.ndarray) -> np.ndarray:
    """Return the range over time of the known values of [T, C], NaN without any [C]."""
    known = np.isfinite(values)
    spans = np.where(known, values, -np.inf).max(axis=0) - np.where(known, values, np.inf).min(axis=0)
    return np.where(known.any(axis=0), spans, np.nan)


def _blur(check: DeepCheck) -> Iterator[_Found]:
    levels = known_median(check.sharpness, axis=0)
    for view, level in enumerate(levels):
        loss = _usual(np.delete(levels, view)) - level
        if loss > _BLUR:
            yield (
                [view],
                f"is less sharp than the other cameras, with {100 * 2.0**-loss:.0f} % of their fine detail: "
                "check focus and lens, and that its clip is not enlarged or strongly compressed",
            )
    relative = check.sharpness - levels
    for view, values in enumerate(relative.T):
        # Compression changes from frame to frame, equally in all cameras if they share an encoder.
        dips = values - known_median(np.delete(relative, view, axis=1), axis=1)
        dips = dips if np.isfinite(dips).any() else values
        spread = 1.5 * _usual(np.abs(dips - _usual(dips)))
        frames = np.flatnonzero(dips < -max(_BLURRED_FRAME, _SPREADS * spread))
        if len(frames):
            yield [view], f"is blurred in {_frames(frames)}: see whether it was touched, or focuses automatically"


def _repeats(check: DeepCheck) -> Iterator[_Found]:
    for view, frames in enumerate(check.repeated):
        if frames:
            yield (
                [view],
                f"repeats its last image in {_frames(frames)} while the other cameras see motion: frames were lost; "
                "copy or record the clip again, without converting its frame rate",
            )


def _overlap(check: DeepCheck) -> Iterator[_Found]:
    for view, shares in enumerate(check.overlaps):
        others = np.delete(shares, view)
        if len(others) and others.max() < _OVERLAP:
            yield (
                [view],
                f"shares at most {100 * others.max():.0f} % of its image with another camera: turn it towards what the "
                "others see, or add a camera in between",
            )


_QUESTIONS: dict[str, Callable[[DeepCheck], Iterator[_Found]]] = {
    "error": _errors,
    "time": _times,
    "exposure": lambda check: _exposures(check.gains),
    "flicker": _flicker,
    "variation": _variations,
    "blur": _blur,
    "repeats": _repeats,
    "overlap": _overlap,
}


def _usual(values: np.ndarray) -> float:
    """Return the median of the values that are not NaN, or NaN."""
    return float(known_median(values, axis=0))


def _frames(frames: Sequence[int] | np.ndarray) -> str:
    """Return frame numbers as text, shortened if there are many."""
    listed = ", ".join(str(frame) for frame in frames[:_MAX_LISTED])
    if len(frames) > _MAX_LISTED:
        return f"{len(frames)} frames ({listed}, ...)"
    return f"{'frame' if len(frames) == 1 else 'frames'} {listed}"


def _listed(names: Sequence[str], count: int) -> str:
    return "all cameras" if len(names) == count else ", ".join(names)
