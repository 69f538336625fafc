"""Alignment of a capture's clips in time.

A timestamp t = 0, 1, ... is a frame of the recording. It is shown by frame k of a clip if

    k = o + r t,    with o the clip's offset and r its frame rate divided by the lowest frame rate.

Numbers of images are times: images with the same number are simultaneous, and folders with
different numbers are refused, or aligned by `open_clips`.

If k is not whole, the nearest frame shows the timestamp; in a clip of variable frame rate, k is a
position on its regular clock. If only o is not whole, this frame is always later by the same time,
the camera's delay (see `Camera`), and the image of the first timestamp is interpolated between two
frames (see `interpolation`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from sys import maxsize

import numpy as np

from morgs_mi.capture.layouts.clips import check_names
from morgs_mi.io.clip_readers import FrameReader
from morgs_mi.platform.checks import composed, few, require
from morgs_mi.platform.config import config_class

_LOG = logging.getLogger(__name__)
_DEFAULT_FPS = 30.0
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
    #: Positions of the images on the clip's regular clock [T].
    positions: np.ndarray
    rate: float  #: Frames of the clip per timestamp.
    delay: float = 0.0  #: Time from a timestamp to the frame that shows it, in frames of the clip.


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


@dataclass(frozen=True, eq=False)
class _Clock:
    """A clip with its offset o and rate r (see the module's docstring)."""

    reader: FrameReader
    length: int  # number of positions that the clip covers
    offset: float
    rate: float
    # Whether its frames show the timestamps with a constant delay: its offset is not whole, its
    # rate is constant, and it has several frames.
    is_shifted: bool

    def timestamp(self, positions: np.ndarray | int) -> np.ndarray:
        """Return the timestamps [...] at positions [...] of the clip."""
        return (np.asarray(positions) - self.offset) / self.rate

    def times(self, timestamps: np.ndarray, gaps: bool) -> ClipTimes:
        """Return the frames that show the timestamps [T]; with `gaps`, none that is far."""
        positions = self.offset + self.rate * timestamps
        if self.is_shifted and self.rate % 1 == 0:
            delay = float(np.floor(positions[0] + 0.5) - positions[0])
            return ClipTimes(np.rint(positions + delay).astype(int), positions, self.rate, delay)
        indices = nearest_frames(self.reader, positions)
        exact = self.reader.positions
        places = indices if exact is None else exact[indices]
        if gaps:
            indices = np.where(np.abs(places - positions) > _NEAR, -1, indices)
        return ClipTimes(indices, places, self.rate)


_Clocks = dict[str, _Clock]  # by the names of the cameras


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
    most = max_frames or maxsize
    check_names(path, "offset", config.offset, [*readers])
    config = replace(config, offset={composed(name): o for name, o in config.offset.items()})
    exact, fps = _clocks(readers, config, fps)
    notes = [*_notes_of_numbers(path, readers, config), *_notes_of_clips(readers)]
    if not config.offset:
        notes += _time_codes(readers)
    for note in notes:
        _LOG.warning("%s: %s", path, note)
    if config.trim or config.offset:
        clocks = _without_drift(exact, most)
        timestamps = _common_timestamps(path, clocks, config, fps)[:most]
    else:
        clocks = {name: replace(clock, rate=1.0) for name, clock in exact.items()}
        timestamps = np.arange(_num_frames(path, clocks, most, config.gaps), dtype=float)
        # Frames with the same index must be simultaneous.
        drift = np.ptp([clock.rate for clock in exact.values()]) * (len(timestamps) - 1)
        if drift > _NEAR:
            rates = ", ".join(f"{r.path.name} {r.fps:.6g}" for r in readers.values() if r.fps)
            raise ValueError(
                f"{path}: all cameras must have the same frame rate, got {rates}, up to "
                f"{drift:.1f} frames apart; use the lowest one with --trim, or set `fps` in "
                "capture.json."
            )
    clips = {name: clock.times(timestamps, config.gaps) for name, clock in clocks.items()}
    spread = _spread(clips, exact) / fps
    if spread > 1e-3:
        _LOG.warning("%s: images of one timestamp are up to %.1f ms apart.", path, 1e3 * spread)
    unchanged = not any(config.offset.values()) and all(
        np.array_equal(clip.frame_indices, np.arange(len(timestamps))) for clip in clips.values()
    )
    for name, clip in clips.items():
        reader = readers[name]
        if reader.positions is not None:
            text = _variable_rate(reader.positions, exact[name].rate * fps, clip.frame_indices)
            notes.append(f"{reader.path.name}: variable frame rate, {text}")
    return Timeline(clips, fps, unchanged, tuple(notes))


def _clocks(
    readers: Mapping[str, FrameReader], config: ReadConfig, fps: float | None
) -> tuple[_Clocks, float]:
    """Return the clocks of the clips by their offsets and their frame rates, and the number of
    timestamps per second.
    """
    clip_fps = {name: fps or reader.fps for name, reader in readers.items()}
    lowest = min(filter(None, clip_fps.values()), default=_DEFAULT_FPS)
    clocks = {}
    for name, reader in readers.items():
        offset = float(config.offset.get(name, 0))
        rate = (clip_fps[name] or lowest) / lowest
        if reader.positions is None:
            # A truncated clip can be trimmed.
            length = reader.num_frames if config.gaps else reader.num_held
            is_shifted = offset % 1 != 0 and reader.num_frames > 1
            clocks[name] = _Clock(reader, length, offset, rate, is_shifted)
        else:
            # Of a frame before the first or after the last one, too.
            index = round(offset)
            nearest = min(max(index, 0), len(reader.positions) - 1)
            offset = float(round(reader.positions[nearest]) + index - nearest)
            length = round(reader.positions[-1]) + 1
            clocks[name] = _Clock(reader, length, offset, rate, False)
    return clocks, lowest


def _notes_of_numbers(
    path: Path, readers: Mapping[str, FrameReader], config: ReadConfig
) -> list[str]:
    """Return a sentence if images with different numbers are paired by an offset.

    Raises:
        ValueError: the numbers of the cameras' images differ without one.
    """
    numbers = {name: reader.numbers for name, reader in readers.items() if reader.numbers}
    is_clip = any(len(clip) > 1 for clip in numbers.values())
    if not is_clip or len({(clip[0], clip.step) for clip in numbers.values()}) < 2:
        return []
    table = ", ".join(f"{name} {_range(clip)}" for name, clip in numbers.items())
    require(
        config.offset,
        path,
        "images with the same number must be simultaneous and all cameras must have the same "
        "numbers",
        table,
        "move the images away whose numbers not all cameras have, leave out the cameras that lack "
        "an image with --gaps, or use the positions of the images in place of their numbers with "
        f"--offset {next(iter(numbers))} 0",
    )
    return [f"Images are aligned by their positions and --offset, not by their numbers: {table}."]


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


def _variable_rate(positions: np.ndarray, fps: float, frame_indices: np.ndarray) -> str:
    """Return a sentence on the spacing of a clip's frames, and on how many of the T timestamps
    repeat a frame or have none.
    """
    period = 1e3 / fps
    late = np.abs(positions - np.rint(positions)).max() * period
    frames = frame_indices[frame_indices >= 0]
    return (
        f"{len(positions)} frames in {round(positions[-1]) + 1} periods of {period:.1f} ms, up to "
        f"{late:.1f} ms off; each timestamp has the frame nearest in time: "
        f"{len(frames) - len(np.unique(frames))} repeat one, {len(frame_indices) - len(frames)} "
        "have none."
    )


def _range(numbers: range) -> str:
    text = f"{numbers[0]} to {numbers[-1]}"
    return text if numbers.step == 1 else f"{text} by {numbers.step}"


def _spread(clips: Mapping[str, ClipTimes], clocks: _Clocks) -> float:
    """Return the largest time between two images of one timestamp by the clips' clocks, in
    timestamps.
    """
    times = np.array([clocks[name].timestamp(clip.positions) for name, clip in clips.items()])
    missing = np.array([clip.frame_indices < 0 for clip in clips.values()])
    latest = np.where(missing, -np.inf, times).max(axis=0)
    earliest = np.where(missing, np.inf, times).min(axis=0)
    return float(np.max(latest - earliest, initial=0))


def _without_drift(clocks: _Clocks, most: int) -> _Clocks:
    """Return the clocks with a whole rate r for each clip that differs from it by less than half a
    frame in the end.

    Programs write 29.97 or 30 fps for the same camera. The distance of the frames from a timestamp
    is then constant.
    """
    periods = min(clock.length / clock.rate for clock in clocks.values())
    last = min(periods, most) - 1
    steady = {}
    for name, clock in clocks.items():
        whole = max(1.0, np.rint(clock.rate))
        is_steady = abs(whole - clock.rate) * last < _NEAR
        steady[name] = replace(clock, rate=whole) if is_steady else clock
    return steady


def _common_timestamps(path: Path, clocks: _Clocks, config: ReadConfig, fps: float) -> np.ndarray:
    """Return the timestamps that all clips cover [T]."""
    # A truncated clip can be trimmed but not shifted.
    if not (config.gaps or config.trim):
        for clock in clocks.values():
            _check_complete(clock.reader, clock.reader.num_frames)
    first = math.ceil(max(clock.timestamp(0) for clock in clocks.values()))
    last = math.floor(min(clock.timestamp(clock.length - 1) for clock in clocks.values()))
    if last < first:
        table = ", ".join(
            f"{name} {clock.timestamp(0) / fps:.2f} to {clock.timestamp(clock.length) / fps:.2f} s"
            for name, clock in clocks.items()
        )
        raise ValueError(f"{path}: the clips have no timestamp in common, {table}; check `offset`.")
    return np.arange(first, last + 1, dtype=float)


def nearest_frames(reader: FrameReader, positions: np.ndarray) -> np.ndarray:
    """Return the frames nearest to ascending positions, int [T]."""
    if reader.positions is None:
        return np.rint(positions).astype(int)
    return np.searchsorted((reader.positions[1:] + reader.positions[:-1]) / 2, positions)


def _check_complete(reader: FrameReader, required: int) -> None:
    """Check that the first `required` frames of a clip can be read."""
    if required > reader.num_held:
        raise ValueError(
            f"{reader.path}: frame {reader.num_held} of {reader.num_frames} cannot be read: the "
            "file is truncated or broken; copy it again, use the frames before it (--frames), "
            "or leave its camera out, of the later frames (--gaps) or of all (--exclude)."
        )


def _num_frames(path: Path, clocks: _Clocks, most: int, gaps: bool) -> int:
    """Return the number of timestamps, up to `most`, of clips that are not aligned."""
    if gaps:
        longest = max(clock.length for clock in clocks.values())
        return min(longest, most)
    lengths = []
    for clock in clocks.values():
        reader = clock.reader
        required = min(reader.num_frames, most)
        lengths.append(required)
        _check_complete(reader, required)
        if reader.positions is None:
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
    if max(lengths) > min(lengths):
        readers = [clock.reader for clock in clocks.values()]
        table = ", ".join(f"{reader.path.name} {reader.num_frames}" for reader in readers)
        raise ValueError(
            f"{path}: all cameras must have the same number of frames, got {table}; use the first "
            f"with --frames {min(lengths)}, those that all clips cover with --trim, align the "
            "clips with --offset, or leave cameras out with --exclude."
        )
    return min(lengths)
