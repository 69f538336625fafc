"""Alignment of a capture's clips in time, and the settings that control how they are read.

A timestamp t = 0, 1, ... is a frame of the recording. It is shown by frame k of a clip if

    k = o + r t,    with o the clip's offset and r its frame rate divided by the lowest frame rate.

Folders of images have an o and r by the numbers of their images, too. The numbers are times: images
with the same number are simultaneous.

In a clip of variable frame rate, k is a position on its regular clock, and the nearest frame shows
the timestamp. If o is not whole, the clip has no frame of the timestamp. With a whole r, the
nearest frame is used unchanged: it is always later by the same time, the camera's delay (see
`Camera`). Otherwise an image is interpolated between two frames (see `interpolation`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import lcm
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.layouts.clips import check_names
from morgs_mi.io.clip_readers import FrameReader
from morgs_mi.platform.bounded import read_json, warn_unread
from morgs_mi.platform.checks import check_number, composed, few
from morgs_mi.platform.config import config_class

_LOG = logging.getLogger(__name__)
_DEFAULT_FPS = 30.0
_INTERVALS = {
    "fps": "[1e-6, 1e6]",
    "display_exposure": "[-100, 100]",
    "white": "[1, 65535]",
}
_SETTINGS = {*_INTERVALS, "test_view", "readout"}
# Distance in frames up to which a frame shows a timestamp.
_NEAR = 0.5


@config_class
class ReadConfig:
    """How a capture is read: clips that do not match, which are refused by default, and near
    planes.
    """

    trim: bool = False
    """Whether to use only the timestamps that all clips cover, at their lowest frame rate."""
    offset: dict[str, float] = field(default_factory=dict)
    """Frame of each listed camera's clip that is simultaneous with frame 0 of the others; negative
    for a clip that started later. Timestamps that not all clips cover are left out, as with trim.
    If it is not whole, the nearest frames are used, and `Camera.delay` is the rest; only the first
    images are interpolated between two frames."""
    gaps: bool = False
    """Whether images may be missing; a camera is left out of the frames that it lacks."""
    without: tuple[str, ...] = ()
    """Names of the cameras that are left out."""
    near: float | None = None
    """Depth of the cameras' near planes, world units; None: a fifth of the smallest reliable depth
    (see `with_near_planes`)."""


@dataclass(frozen=True, eq=False)
class ClipTimes:
    """Frames of one clip that show the timestamps of the recording."""

    frame_indices: np.ndarray  #: The clip's frames in ascending order, -1 for none, int [T].
    #: Share of the time to the next frame that has passed at each timestamp [T]; None: no image is
    #: interpolated.
    shares: np.ndarray | None
    delay: float  #: Time from a timestamp to the frame that shows it, in frames of the clip.
    rate: float  #: Frames of the clip per timestamp.


@dataclass(frozen=True, eq=False)
class Timeline:
    """Frames of each clip that show the timestamps of the recording."""

    clips: Mapping[str, ClipTimes]  #: Of each camera's clip, by the camera's name.
    fps: float  #: Timestamps per second.
    unchanged: bool  #: Whether timestamp t is frame t of every clip.
    #: A sentence for each clip of variable frame rate, and on the numbers of images.
    notes: tuple[str, ...] = ()

    @property
    def num_frames(self) -> int:
        """Number of timestamps."""
        return len(next(iter(self.clips.values())).frame_indices)


def timeline(
    path: Path,
    readers: Mapping[str, FrameReader],
    config: ReadConfig,
    max_frames: int | None,
    fps: float | None,
) -> Timeline:
    """Return the common timeline of the clips of the capture `path`.

    Args:
        path: the capture folder, for messages.
        readers: the clips by the names of their cameras.
        config: how clips that do not match are read.
        max_frames: number of timestamps at most.
        fps: actual frame rate of all clips, or None for the rates in their headers.

    Raises:
        ValueError: lengths or rates differ or a rate varies and `config` does not resolve it, a
            clip is cut off, the clips have no timestamp in common, or `config` names an unknown
            camera or has an offset that is not finite.
    """
    check_names(path, "offset", config.offset, [*readers])
    config = replace(config, offset={composed(name): o for name, o in config.offset.items()})
    exact, notes = _by_numbers(path, readers, config, _clocks(readers, config, fps))
    notes += _notes_of_clips(readers)
    if not config.offset:
        notes += _time_codes(readers)
    for note in notes:
        _LOG.warning("%s: %s", path, note)
    if config.trim or config.offset:
        clocks = _without_drift(exact, readers, max_frames)
        timestamps = _common_timestamps(path, readers, config, clocks)[:max_frames]
    else:
        clocks = replace(exact, rates=np.ones(len(readers)))
        count = _num_frames(path, [*readers.values()], max_frames, config.gaps)
        timestamps = np.arange(count, dtype=float)
        # Frames with the same index must be simultaneous.
        drift = np.ptp(exact.rates) * (len(timestamps) - 1)
        if drift > _NEAR:
            rates = ", ".join(f"{r.path.name} {r.fps:.6g}" for r in readers.values() if r.fps)
            raise ValueError(
                f"{path}: all cameras must have the same frame rate, got {rates}, up to "
                f"{drift:.1f} frames apart; use the lowest one with --trim, or set `fps` in "
                "capture.json."
            )
    clips = {}
    times = np.zeros((len(readers), len(timestamps)))
    has_frame = np.zeros(times.shape, bool)
    for c, (name, reader) in enumerate(readers.items()):
        positions = clocks.offsets[c] + clocks.rates[c] * timestamps
        clip = _clip_times(reader, positions, float(clocks.rates[c]), config.offset.get(name, 0))
        places = _image_positions(reader, clip, positions)
        if config.gaps:
            # Images that are far from their timestamps are left out.
            is_far = np.abs(places - positions) > _NEAR
            clip = replace(clip, frame_indices=np.where(is_far, -1, clip.frame_indices))
        clips[name] = clip
        times[c] = (places - exact.offsets[c]) / exact.rates[c]
        has_frame[c] = clip.frame_indices >= 0
    # Images of one timestamp that are apart, by the clips' clocks.
    latest = np.where(has_frame, times, -np.inf).max(axis=0)
    earliest = np.where(has_frame, times, np.inf).min(axis=0)
    spread = float(np.max(latest - earliest, initial=0)) / exact.fps
    if spread > 1e-3:
        _LOG.warning("%s: images of one timestamp are up to %.1f ms apart.", path, 1e3 * spread)
    unchanged = not any(config.offset.values()) and all(
        np.array_equal(clip.frame_indices, np.arange(len(clip.frame_indices)))
        for clip in clips.values()
    )
    for name, reader in readers.items():
        if reader.positions is not None and reader.fps:
            frames = clips[name].frame_indices
            frames = frames[frames >= 0]
            repeats = len(frames) - len(np.unique(frames))
            late = np.abs(reader.positions - np.rint(reader.positions)).max() / reader.fps
            notes.append(
                f"{reader.path.name}: variable frame rate, {len(reader.positions)} frames in "
                f"{_periods(reader)} periods of {1e3 / reader.fps:.1f} ms, up to "
                f"{1e3 * late:.1f} ms off; each timestamp has the frame nearest in time: {repeats} "
                f"repeat one, {len(timestamps) - len(frames)} have none."
            )
    return Timeline(clips, exact.fps, unchanged, tuple(notes))


def _by_numbers(
    path: Path,
    readers: Mapping[str, FrameReader],
    config: ReadConfig,
    clocks: _Clocks,
) -> tuple[_Clocks, list[str]]:
    """Return the clocks of clips by the numbers of their images, too, and a sentence for each
    assumption.
    """
    numbers = {name: clip.numbers for name, clip in readers.items() if clip.numbers is not None}
    moving = any(len(clip) > 1 for clip in numbers.values())
    if not moving or len({(clip[0], clip.step) for clip in numbers.values()}) == 1:
        return clocks, []
    table = ", ".join(f"{name} {_range(clip)}" for name, clip in numbers.items())
    if config.offset and not config.trim:
        note = f"Images are aligned by their positions and --offset, not by their numbers: {table}."
        return clocks, [note]
    common = sorted(set.intersection(*map(set, numbers.values())))
    if not config.trim or not common:
        remedy = (
            f"the {len(common)} common ones with --trim, all numbers with --gaps, which leaves out "
            "the cameras that lack an image, or "
        )
        raise ValueError(
            f"{path}: images with the same number must be simultaneous and all cameras must have "
            f"the same numbers, got {table}; use {remedy if common else ''}the positions of the "
            f"images in place of their numbers with --offset {next(iter(numbers))} 0."
        )
    note = (
        f"Images with the same number are simultaneous: {table}. Used are {_range(common)}, which "
        "all cameras have."
    )
    steps = [clip.step for clip in numbers.values()]
    # Other clips start with the first of these numbers.
    first = min(clip[0] for clip in numbers.values())
    clips = [numbers.get(name, range(first, first + 1, min(steps))) for name in readers]
    offsets = np.array([(common[0] - clip[0]) / clip.step for clip in clips])
    return _Clocks(
        clocks.offsets + offsets * clocks.rates,
        clocks.rates * np.array([lcm(*steps) / clip.step for clip in clips]),
        # The time between two timestamps, in frames of the clip with the most frames per time.
        clocks.fps / (lcm(*steps) / min(steps)),
    ), [note]


def _notes_of_clips(readers: Mapping[str, FrameReader]) -> list[str]:
    """Return the notes of the clips, each with the cameras that have it."""
    cameras: dict[str, list[str]] = {}
    for name, reader in readers.items():
        for note in reader.notes:
            cameras.setdefault(note, []).append(name)
    return [f"{few(cameras[note])}: {note}" for note in cameras]


def _time_codes(readers: Mapping[str, FrameReader]) -> list[str]:
    """Return a sentence if overlapping clips began at different times by their time codes."""
    rows = [(reader.fps, reader.start, reader.num_frames) for reader in readers.values()]
    fps, starts, counts = np.array(rows, float).T
    spread = np.ptp(starts)
    offsets = np.rint((starts[0] - starts) * fps)
    # Comparisons are false if a time code or a rate is unknown.
    if not (offsets.any() and spread < (counts / fps).min()):
        return []
    pairs = zip(readers, offsets, strict=True)
    options = " ".join(f"{name} {offset:g}" for name, offset in pairs if offset)
    return [
        f"The time codes of the clips begin up to {spread:.3g} s apart; if they were synchronised, "
        f"align the clips with --offset {options}."
    ]


def _range(numbers: Sequence[int]) -> str:
    if len(numbers) == 1:
        return str(numbers[0])
    text = f"{numbers[0]} to {numbers[-1]}"
    step = numbers[1] - numbers[0]
    return text if step == 1 else f"{text} by {step}"


def _clip_times(
    reader: FrameReader, positions: np.ndarray, rate: float, offset: float
) -> ClipTimes:
    """Return the frames of a clip that show the timestamps at `positions` [T], by the clip's rate
    and its offset in `ReadConfig`.
    """
    if reader.positions is not None or reader.num_frames < 2 or offset % 1 == 0:
        return ClipTimes(nearest_frames(reader, positions), None, 0.0, rate)
    if rate % 1 == 0:
        # The same for all of its frames.
        delay = float(np.floor(positions[0] + 0.5) - positions[0])
        return ClipTimes(np.rint(positions + delay).astype(int), None, delay, rate)
    indices = np.clip(np.floor(positions).astype(int), 0, reader.num_frames - 2)
    return ClipTimes(indices, positions - indices, 0.0, rate)


def _image_positions(reader: FrameReader, clip: ClipTimes, positions: np.ndarray) -> np.ndarray:
    """Return the positions of the images that show the timestamps at `positions` [T]."""
    if clip.shares is not None:
        return positions
    if reader.positions is not None:
        return reader.positions[clip.frame_indices]
    return clip.frame_indices - clip.delay


@dataclass(frozen=True)
class _Clocks:
    """Offset o and rate r of every clip [C], and the number of timestamps per second (see the
    module's docstring).
    """

    offsets: np.ndarray
    rates: np.ndarray
    fps: float


def _clocks(readers: Mapping[str, FrameReader], config: ReadConfig, fps: float | None) -> _Clocks:
    """Return the clocks of the clips by their offsets and their frame rates."""
    clip_fps = [fps or reader.fps for reader in readers.values()]
    lowest = min((rate for rate in clip_fps if rate), default=fps or _DEFAULT_FPS)
    offsets = np.array([config.offset.get(name, 0) for name in readers], float)
    for c, reader in enumerate(readers.values()):
        if reader.positions is not None:
            # Of a frame before the first or after the last one, too.
            index = round(float(offsets[c]))
            nearest = min(max(index, 0), len(reader.positions) - 1)
            offsets[c] = round(reader.positions[nearest]) + index - nearest
    return _Clocks(offsets, np.array([(rate or lowest) / lowest for rate in clip_fps]), lowest)


def _without_drift(
    clocks: _Clocks, readers: Mapping[str, FrameReader], max_frames: int | None
) -> _Clocks:
    """Return the clocks with a whole rate r for each clip that differs from it by less than half a
    frame in the end.

    Programs write 29.97 or 30 fps for the same camera. The distance of the frames from a timestamp
    is then constant.
    """
    periods = min(
        _periods(reader) / rate for reader, rate in zip(readers.values(), clocks.rates, strict=True)
    )
    whole = np.maximum(1, np.rint(clocks.rates))
    drift = np.abs(whole - clocks.rates) * (min(periods, max_frames or periods) - 1)
    return replace(clocks, rates=np.where(drift < _NEAR, whole, clocks.rates))


def _common_timestamps(
    path: Path,
    readers: Mapping[str, FrameReader],
    config: ReadConfig,
    clocks: _Clocks,
) -> np.ndarray:
    """Return the timestamps that all clips cover [T]."""
    # A truncated clip can be trimmed but not shifted.
    is_held = config.trim and not config.gaps
    clips = readers.values()
    if not (config.gaps or config.trim):
        for reader in clips:
            _check_complete(reader, reader.num_frames)
    lengths = np.array(
        [r.num_held if is_held and r.positions is None else _periods(r) for r in clips]
    )
    first = np.ceil(np.max(-clocks.offsets / clocks.rates))
    last = np.floor(np.min((lengths - 1 - clocks.offsets) / clocks.rates))
    if last < first:
        spans = np.stack([0 * lengths, lengths], axis=1) - clocks.offsets[:, None]
        spans = spans / (clocks.rates * clocks.fps)[:, None]
        table = ", ".join(
            f"{name} {start:.2f} to {stop:.2f} s"
            for name, (start, stop) in zip(readers, spans, strict=True)
        )
        raise ValueError(f"{path}: the clips have no timestamp in common, {table}; check `offset`.")
    return np.arange(first, last + 1)


def nearest_frames(reader: FrameReader, positions: np.ndarray) -> np.ndarray:
    """Return the frames nearest to ascending positions, int [T]."""
    if reader.positions is None:
        return np.rint(positions).astype(int)
    return np.searchsorted((reader.positions[1:] + reader.positions[:-1]) / 2, positions)


def _periods(reader: FrameReader) -> int:
    """Return the number of positions that a clip covers: its number of frames if their rate is
    constant.
    """
    return reader.num_frames if reader.positions is None else round(reader.positions[-1]) + 1


def _check_complete(reader: FrameReader, required: int) -> None:
    """Check that the first `required` frames of a clip can be read."""
    if required > reader.num_held:
        raise ValueError(
            f"{reader.path}: frame {reader.num_held} of {reader.num_frames} cannot be read: the "
            "file is truncated or broken; copy it again, use the frames before it (`max_frames`), "
            "or leave its camera out, of the later frames (--gaps) or of all (--exclude)."
        )


def _num_frames(
    path: Path, readers: Sequence[FrameReader], max_frames: int | None, gaps: bool
) -> int:
    """Return the number of timestamps of clips that are not aligned."""
    if gaps:
        longest = max(map(_periods, readers))
        return min(longest, max_frames or longest)
    lengths = [min(reader.num_frames, max_frames or reader.num_frames) for reader in readers]
    for reader, required in zip(readers, lengths, strict=True):
        _check_complete(reader, required)
        if reader.positions is None or not reader.fps:
            continue
        # Frame t must show timestamp t.
        late = reader.positions[:required] - np.arange(required)
        frame = int(np.argmax(np.abs(late) > _NEAR))
        if abs(late[frame]) > _NEAR:
            raise ValueError(
                f"{reader.path}: expected a constant frame rate, got frame {frame} "
                f"{1e3 * late[frame] / reader.fps:.0f} ms late; use the frames nearest in time "
                "(--trim), leave the camera out where it has none (--gaps), or convert the clip."
            )
    shortest = min(lengths)
    if max(lengths) > shortest:
        table = ", ".join(f"{reader.path.name} {reader.num_frames}" for reader in readers)
        raise ValueError(
            f"{path}: all cameras must have the same number of frames, got {table}; use the first "
            f"with `max_frames={shortest}`, those that all clips cover with --trim, align the "
            "clips with --offset, or leave cameras out with --exclude."
        )
    return shortest


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a capture's `capture.json`, or {} without such a file.

    They are ``fps``, ``test_view`` and ``readout``, the frames from the exposure of an image's
    first row to the exposure of its last row: a number for all cameras, or an object with the
    numbers that are not 0, by the cameras' names; ``display_exposure`` in stops, see `Capture`; and
    ``white``, its value in images of 16 bits.

    Raises:
        ValueError: the file is not a JSON object, or a setting is not valid.
    """
    if not path.exists():
        return {}
    settings = read_json(path)
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: expected a JSON object, got another value; correct it.")
    if "scene" not in settings:  # a synthetic capture describes itself
        warn_unread(path, settings.keys() - _SETTINGS)
    for name, interval in _INTERVALS.items():
        if (value := settings.get(name)) is not None:
            check_number(path, name, value, interval)
    readout = settings.get("readout", 0.0)
    for value in readout.values() if isinstance(readout, dict) else [readout]:
        check_number(path, "readout", value, "[-1, 1]")
    return settings
