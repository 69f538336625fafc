"""Check of a whole recording: cameras that differ from the others in time, exposure, sharpness or
position.

`rig_check` checks the poses on the first frame; this module reads many frames. A finding is a
sentence with numbers and advice. Each row of `_QUESTIONS` has a question, its measure, its limit
and its sentence. The limits are far above the values of clips without faults.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.color_correction import matched_colors
from morgs_mi.capture.features import Match
from morgs_mi.capture.points import SharedFeatures
from morgs_mi.core.rig import overlaps
from morgs_mi.studio.calibration.checks.rig_check import RigCheck
from morgs_mi.studio.calibration.checks.signals import (
    Lamp,
    Signals,
    brightness,
    known_median,
    lamp_flicker,
    others_median,
    repeated_frames,
)
from morgs_mi.studio.calibration.checks.synchrony import consensus, time_offsets

# Largest number of frames that are read: the start of a longer recording shows its faults.
MAX_FRAMES = 120
# Multiple of the other cameras' reprojection error from which an error is a finding.
_TIMES_ERROR = 3.0
# Frames. Half a recording has at least this many, and its time offset differs from the other half's
# by less than this.
_MIN_HALF = 24
_OFFSET_CHANGE = 0.75
# Least number of matches of a pair of views whose gains are compared.
_MIN_SAMPLES = 16
# Error of a median log ratio that no number of points removes, because surfaces look different from
# two sides.
_LOG_ERROR = 0.02
# Octaves, and multiples of the usual deviation, by which a blurred image is less sharp than the
# others of its camera.
_BLURRED_FRAME = 0.5
_SPREADS = 6.0
# Number of frames that a sentence lists.
_MAX_LISTED = 6
_CORRECTION = "; fit corrects it (not with --exposure off)"


@dataclass(frozen=True)
class Finding:
    """A fault of a recording."""

    #: Name of the check: error, time, exposure, variation, flicker, blur, repeats or overlap.
    question: str
    cameras: tuple[str, ...]  #: Names of the cameras that it concerns.
    sentence: str  #: Numbers and advice.


@dataclass(frozen=True)
class DeepCheck:
    """Result of checking a recording; missing measurements are NaN."""

    names: tuple[str, ...]  #: Names of the C cameras.
    frames: int  #: Number T of frames that were read.
    fps: float  #: Frames per second.
    given: tuple[float, ...]  #: Time offset with which each camera was read, frames.
    errors: np.ndarray  #: Median reprojection error of each camera [C], px.
    offsets: np.ndarray  #: Time offset of each camera from the median [C], frames.
    halves: np.ndarray  #: The same in the first and the last half of the frames [2, C].
    #: Log gain of each camera's channels in linear light, relative to the median [C, 3].
    gains: np.ndarray
    #: Log brightness of each camera over time, relative to its median [T, C].
    brightness: np.ndarray
    sharpness: np.ndarray  #: Per image [T, C], octaves.
    repeated: tuple[tuple[int, ...], ...]  #: Per camera the frames that repeat the previous one.
    lamps: tuple[Lamp | None, ...]  #: Per camera the flicker of lamps, or None.
    overlaps: np.ndarray  #: Share of each camera's image that each other camera sees [C, C].
    findings: tuple[Finding, ...] = ()  #: Faults.

    @property
    def largest_overlaps(self) -> np.ndarray:
        """Share of each camera's image that the camera with the largest overlap sees [C]."""
        shares = np.where(np.eye(len(self.names), dtype=bool), np.nan, self.overlaps)
        return np.fmax.reduce(shares, axis=1)

    @property
    def unmeasured(self) -> str:
        """The missing measurements and their cameras, in a sentence; empty if none is missing."""
        values = {
            "time offsets": self.offsets,
            "exposure against the other cameras": self.gains.mean(axis=1),
        }
        parts = [
            f"{quantity} of {cameras}"
            for quantity, value in values.items()
            if (cameras := self._cameras_without(value))
        ]
        if not parts:
            return ""
        return f"Not measured, without enough common motion or matches: {'; '.join(parts)}."

    def _cameras_without(self, values: np.ndarray) -> str:
        """Return the names of the cameras with a missing one of the values [C]."""
        pairs = zip(self.names, np.isnan(values), strict=True)
        cameras = [name for name, is_missing in pairs if is_missing]
        return "all cameras" if len(cameras) == len(self.names) else ", ".join(cameras)

    def as_dict(self) -> dict[str, Any]:
        """Return all measurements and findings in JSON types."""
        return {
            key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in asdict(self).items()
        }


def check_deep(
    capture: Capture, shared: SharedFeatures, rig: RigCheck, signals: Signals
) -> DeepCheck:
    """Return the measurements and the faults of a recording.

    Args:
        capture: at its recorded size.
        shared: features of its first frame.
        rig: result of checking the poses with these features.
        signals: measurements of its frames.
    """
    bands = brightness(signals)
    check = DeepCheck(
        names=capture.names,
        frames=len(bands),
        fps=capture.fps,
        given=tuple(capture.reading.offset.get(name, 0) for name in capture.names),
        errors=np.array([camera.error for camera in rig.cameras]),
        offsets=time_offsets(capture.cameras, signals.thumbs),
        halves=_half_offsets(capture, signals.thumbs),
        gains=_gains(capture, shared),
        brightness=known_median(bands, axis=2),
        sharpness=signals.sharpness,
        repeated=repeated_frames(signals),
        lamps=tuple(lamp_flicker(bands[:, c], capture.fps) for c in range(len(capture.cameras))),
        overlaps=overlaps(capture.cameras, capture.points),
    )
    findings = [f for question in _QUESTIONS for f in question.findings(check.names, check)]
    return replace(check, findings=(*findings, *_exposure_findings(check.names, check.gains)))


def _half_offsets(capture: Capture, thumbs: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time offsets in the first and the last half of the frames [2, C], NaN in short
    recordings.
    """
    half = len(thumbs[0]) // 2
    if half < _MIN_HALF:
        return np.full((2, len(capture.cameras)), np.nan)
    parts = ([t[:half] for t in thumbs], [t[half:] for t in thumbs])
    return np.array([time_offsets(capture.cameras, part) for part in parts])


def check_exposures(capture: Capture, shared: SharedFeatures) -> list[Finding]:
    """Return a finding for each camera with a different exposure or white balance in the first
    frame.

    Args:
        capture: a capture.
        shared: features of its first frame in its size.
    """
    return _exposure_findings(capture.names, _gains(capture, shared))


def _exposure_findings(names: Sequence[str], gains: np.ndarray) -> list[Finding]:
    return [*_EXPOSURE.findings(names, gains), *_BALANCE.findings(names, gains)]


def _gains(capture: Capture, shared: SharedFeatures) -> np.ndarray:
    """Return the log gains of all cameras [C, 3] that explain colours of points in two views."""
    pairs, colors = _samples(capture, shared)
    ratios = [_log_ratios(pair, colors) for pair in pairs]
    middles = np.reshape([np.median(ratio, axis=0) for ratio in ratios], (-1, 3))
    weights = np.array([_weight(*each) for each in zip(ratios, middles, strict=True)])
    views = [pair.views for pair in pairs]
    gains = [consensus(len(colors), views, channel, weights) for channel in middles.T]
    return np.stack(gains, axis=1)


def _samples(capture: Capture, shared: SharedFeatures) -> tuple[list[Match], list[np.ndarray]]:
    """Return the matches of pairs of views with enough of them, and the colours [K, 3] of all
    features.
    """
    images = next(capture.displayed().partial_frames(0, 1)).images
    pairs, colors = matched_colors(capture.cameras, images, shared.features, shared.matches)
    return [pair for pair in pairs if len(pair.features) >= _MIN_SAMPLES], colors


def _log_ratios(pair: Match, colors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the log ratios [n, 3] of the colours of points in the second and the first view."""
    a, b = (colors[view][pair.features[:, k]] for k, view in enumerate(pair.views))
    return np.log(b / a)


def _weight(ratios: np.ndarray, middle: np.ndarray) -> float:
    """Return the weight of a median of log ratios [n, 3]: the inverse of its variance."""
    spread = np.abs(ratios - middle).mean()
    return 1 / (spread**2 / len(ratios) + _LOG_ERROR**2)


# Values of each camera [C] by name: `value` is compared with the limit, the others stand in the
# sentence.
_Values = Mapping[str, Sequence[Any] | np.ndarray]


@dataclass(frozen=True)
class _Question:
    """Row of the table of questions."""

    name: str  # as in `Finding.question`
    measure: Callable[[Any], _Values]  # returns the values of each camera
    limit: float  # a camera with a larger `value` has a fault
    sentence: str  # follows the name of the camera, with values in braces
    common: bool = False  # whether cameras with the same sentence share a finding

    def findings(self, names: Sequence[str], measured: Any) -> list[Finding]:
        """Return the faults of the cameras `names` in what the question measures."""
        values = self.measure(measured)
        groups: dict[Any, list[str]] = {}
        for view in np.flatnonzero(np.asarray(values["value"], float) > self.limit).tolist():
            key = (self._text(values, view), None if self.common else view)
            groups.setdefault(key, []).append(names[view])
        return [
            Finding(self.name, tuple(n), f"{', '.join(n)} {text}.")
            for (text, _), n in groups.items()
        ]

    def _text(self, values: _Values, view: int) -> str:
        """Return the sentence with the values of a view."""
        row = {key: column[view] for key, column in values.items()}
        return self.sentence.format(**row).replace("%", " %")


def _errors(check: DeepCheck) -> _Values:
    usual = others_median(check.errors)
    return {
        "value": np.where(check.errors > _TIMES_ERROR * usual, check.errors, np.nan),
        "usual": usual,
    }


def _drifts(check: DeepCheck) -> _Values:
    change = check.halves[1] - check.halves[0]
    return {"value": np.abs(change), "side": _sides(change), "frames": [check.frames] * len(change)}


def _times(check: DeepCheck) -> _Values:
    value = np.where(_are_drifting(check), np.nan, np.abs(check.offsets))
    option = np.array(check.given) - np.round(np.nan_to_num(check.offsets))
    seconds = value / check.fps
    return {
        "value": value,
        "ms": 1e3 * seconds,
        "side": _sides(check.offsets),
        "name": check.names,
        "option": option,
    }


def _are_drifting(check: DeepCheck) -> np.ndarray:
    """Return the mask of the cameras whose offset changes during the recording."""
    changes = np.vstack([check.halves - check.offsets, check.halves[1] - check.halves[0]])
    return np.any(np.abs(changes) >= _OFFSET_CHANGE, axis=0)


def _sides(offsets: np.ndarray) -> np.ndarray:
    return np.where(offsets > 0, "ahead of", "behind")


def _exposures(gains: np.ndarray) -> _Values:
    change = np.expm1(gains.mean(axis=1))
    return {"value": np.abs(change), "side": np.where(change > 0, "brighter", "darker")}


def _balances(gains: np.ndarray) -> _Values:
    balance = np.expm1(gains - gains.mean(axis=1, keepdims=True))
    return {"value": np.abs(balance).max(axis=1), **dict(zip("RGB", balance.T, strict=True))}


def _flickers(check: DeepCheck) -> _Values:
    lamps = _strongest(check.lamps)
    return {
        "value": [lamp.amplitude for lamp in lamps],
        "alias": [lamp.alias for lamp in lamps],
        "mains": [" or ".join(map(str, lamp.mains)) for lamp in lamps],
        "exposure": [" or ".join(f"1/{2 * mains}" for mains in lamp.mains) for lamp in lamps],
    }


def _strongest(lamps: Sequence[Lamp | None]) -> list[Lamp]:
    """Return for each camera the strongest flicker by the same mains, or one of no amplitude."""
    flickers = sorted(filter(None, lamps), key=lambda lamp: lamp.amplitude)
    strongest = {lamp.mains: lamp for lamp in flickers}
    return [strongest[lamp.mains] if lamp else Lamp((), 0.0, 0.0) for lamp in lamps]


def _variations(check: DeepCheck) -> _Values:
    values = check.brightness - _common_brightness(check)
    jump = np.fmax.reduce(np.abs(np.diff(values, axis=0)), axis=0, initial=np.nan)
    return {"value": _changes(check, values), "jump": np.expm1(jump)}


def _common_brightness(check: DeepCheck) -> np.ndarray:
    """Return the log brightness over time [T, 1] if it changes alike in all cameras, otherwise
    zeros.
    """
    common = known_median(check.brightness, axis=1)[:, None]
    rest = known_median(_range(check.brightness - common), axis=0)
    alike = len(check.names) > 2 and rest < 0.5 * _range(common)[0]
    return common if alike else np.zeros_like(common)


def _changes(check: DeepCheck, values: np.ndarray) -> np.ndarray:
    """Return the relative change of each camera's log brightness [T, C], NaN if its flicker
    explains it.
    """
    # The range of a flicker is twice its amplitude; twice that range has another cause as well.
    flicker = np.array([4 * lamp.amplitude if lamp else 0 for lamp in check.lamps])
    return np.where(_range(values) > flicker, np.expm1(_range(values)), np.nan)


def _range(values: np.ndarray) -> np.ndarray:
    """Return the range over time of the known values of [T, C], NaN without any [C]."""
    return np.fmax.reduce(values, axis=0) - np.fmin.reduce(values, axis=0)


def _blurs(check: DeepCheck) -> _Values:
    levels = known_median(check.sharpness, axis=0)
    loss = others_median(levels) - levels
    return {"value": loss, "detail": 2.0**-loss}


def _blurred_frames(check: DeepCheck) -> _Values:
    dips = _dips(check.sharpness)
    spread = 1.5 * known_median(np.abs(dips - known_median(dips, axis=0)), axis=0)
    limits = -np.fmax(_BLURRED_FRAME, _SPREADS * spread)
    return _listed([np.flatnonzero(mask) for mask in (dips < limits).T])


def _dips(sharpness: np.ndarray) -> np.ndarray:
    """Return each image's sharpness relative to its camera's and to the other cameras' [T, C]."""
    relative = sharpness - known_median(sharpness, axis=0)
    # Compression changes from frame to frame, equally in all cameras if they share an encoder.
    return relative - np.nan_to_num(others_median(relative))


def _listed(frames: Sequence[Sequence[int] | np.ndarray]) -> _Values:
    """Return the number of frames of each camera, and the frames as text, shortened if they are
    many.
    """
    return {"value": [len(camera) for camera in frames], "frames": [_text(f) for f in frames]}


def _text(frames: Sequence[int] | np.ndarray) -> str:
    """Return the first ones of some frames as text."""
    end = ", ..." if len(frames) > _MAX_LISTED else ""
    return ", ".join(map(str, frames[:_MAX_LISTED])) + end


# These two rows measure the gains [C, 3], which `check_exposures` has without the rest of a check.
_EXPOSURE = _Question(
    "exposure",
    _exposures,
    0.1,
    "is {value:.0%} {side} than the other cameras: set the same exposure and gain" + _CORRECTION,
)
_BALANCE = _Question(
    "exposure",
    _balances,
    0.05,
    "has another white balance than the other cameras (R {R:+.0%}, G {G:+.0%}, B {B:+.0%}): set a "
    "fixed one" + _CORRECTION,
)
# Change of the brightness over time; a person walking through a room causes 0.05.
_VARIATION = 0.08
# Where the limit is 0, the measure has its own.
_QUESTIONS = (
    _Question(
        "error",
        _errors,
        0.7,  # px
        "has a reprojection error of {value:.2f} px, the others {usual:.2f} px: check its lens "
        "model and focal length, or calibrate again (morgs-mi calibrate)",
    ),
    _Question(
        "time",
        _drifts,
        _OFFSET_CHANGE,
        "moves {value:.1f} frames {side} the other cameras during the first {frames} frames: "
        "frames were lost or its clock runs at another rate; copy the clip again, or convert it "
        "with its true time stamps",
    ),
    _Question(
        "time",
        _times,
        0.65,  # frames, nearer to a whole frame than to none
        "is {value:.1f} frames ({ms:.0f} ms) {side} the other cameras: use --offset {name} "
        "{option:g}, or record with synchronised cameras",
    ),
    _Question(
        "flicker",
        _flickers,
        0,
        "flicker by {value:.1%} at {alias:.1f} Hz, as lamps on {mains} Hz mains do: expose for a "
        "multiple of {exposure} s, or use lamps without flicker; fit corrects what the cameras do "
        "not have in common",
        common=True,
    ),
    _Question(
        "variation",
        lambda check: {"value": _changes(check, _common_brightness(check) + 0 * check.brightness)},
        _VARIATION,
        "change their brightness alike, by {value:.0%} over time: the light of the scene changes; "
        "use constant light",
        common=True,
    ),
    _Question(
        "variation",
        _variations,
        _VARIATION,
        "changes its brightness by {value:.0%} over time, up to {jump:.0%} from frame to frame: "
        "fix the exposure" + _CORRECTION,
    ),
    _Question(
        "blur",
        _blurs,
        1.0,  # octaves
        "is less sharp than the other cameras, with {detail:.0%} of their fine detail: check "
        "focus and lens, and that its clip is not enlarged or strongly compressed",
    ),
    _Question(
        "blur",
        _blurred_frames,
        0,
        "is blurred in frames {frames}: see whether it was touched, or focuses automatically",
    ),
    _Question(
        "repeats",
        lambda check: _listed(check.repeated),
        0,
        "repeats its last image in frames {frames} while the other cameras see motion: frames "
        "were lost; copy or record the clip again, without converting its frame rate",
    ),
    _Question(
        "overlap",
        lambda check: {"value": 1 - check.largest_overlaps, "share": check.largest_overlaps},
        0.7,  # px
        "shares at most {share:.0%} of its image with another camera: turn it towards what the "
        "others see, or add a camera in between",
    ),
)
