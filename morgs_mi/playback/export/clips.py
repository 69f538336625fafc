"""Export of a stream's frames: one file per frame, or a video along a camera path."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, repeat
from pathlib import Path

import numpy as np

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Arrays
from morgs_mi.io.compressed_ply import write_compressed_ply
from morgs_mi.io.ply import write_ply
from morgs_mi.platform.checks import check_number
from morgs_mi.platform.progress import StepReport
from morgs_mi.playback.default_rig import DEFAULT_RIG
from morgs_mi.playback.export.formats import Format, frame_files
from morgs_mi.playback.export.paths import CameraPath, focus, load_path, orbit, through_cameras
from morgs_mi.playback.player import available_channels, render
from morgs_mi.playback.stream_header import render_config, stream_origin

# Angle of an orbit around Gaussians without a recording. Scenes fall apart from behind, and may be
# tilted.
_SWING = 60.0

_CELL_BITS = 10  # of a Z-order curve per axis


def frame_numbers(stream: FrameSource) -> list[int]:
    """Return the indices of a stream's frames, without decoding them.

    Raises:
        ValueError: the stream has no frame.
    """
    numbers = stream.frame_numbers()
    if not numbers:
        raise ValueError(f"{stream.path}: expected at least one frame, got a header alone.")
    return numbers


def select_frames(stream: FrameSource, frames: str | None) -> list[int]:
    """Return the frames of a stream that `frames` selects: ``12``, ``10:20`` (without 20), ``::5``;
    None selects all.

    Raises:
        ValueError: `frames` has another syntax, or selects no frame of the stream.
    """
    numbers = frame_numbers(stream)
    if frames is None:
        return numbers
    parts = frames.split(":")
    defaults = (numbers[0], numbers[-1] + 1, 1)
    try:
        pairs = zip(parts, defaults, strict=len(parts) > len(defaults))
        values = [int(part) if part.strip() else default for part, default in pairs]
        start, stop, step = (*values, values[0] + 1 if len(parts) == 1 else 1, 1)[:3]
        indices = range(start, stop, step)
    except ValueError:
        indices = range(0)
    if selected := [number for number in numbers if number in indices]:
        return selected
    raise ValueError(
        "select_frames(): `frames` must be like 12, 10:20 or 0:100:5 and select frames of "
        f"{stream.path}, {numbers[0]} to {numbers[-1]}, got {frames!r}."
    )


def in_z_order(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians along a Z-order curve of their centres: neighbours on it are neighbours in
    space.
    """
    return gaussians.select(np.argsort(z_order(gaussians.numpy()["means"]), kind="stable"))


def z_order(points: np.ndarray) -> np.ndarray:
    """Return the places int64 [N] of points [N, 3] on a Z-order curve.

    The cells of its grid have equal numbers of points along each axis. Unlike cells of equal size,
    they are not widened by far points.
    """
    ranks = points.argsort(axis=0).argsort(axis=0)
    cells = (ranks << _CELL_BITS) // max(1, len(points))
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        for bit in range(_CELL_BITS):
            keys |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return keys


def write_ordered_ply(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a compressed PLY file along a Z-order curve."""
    write_compressed_ply(path, in_z_order(gaussians))


def write_ply_files(
    stream: FrameSource,
    output: str | Path,
    kind: Format,
    frames: Sequence[int],
    progress: StepReport,
) -> None:
    """Write frames of a stream as PLY files of a format in `PLY`, see `write_each`."""
    write = write_ordered_ply if kind.name == "compressed.ply" else write_ply
    write_each(play(stream), output, f".{kind.name}", write, frames, progress)


def write_each(
    clip: Iterable[tuple[int, Gaussians]],
    output: str | Path,
    suffix: str,
    write: Callable[[Path, Gaussians], None],
    frames: Sequence[int],
    progress: StepReport,
) -> None:
    """Write frames as ``0000.ply``, ``0001.ply``, ... into a new folder, or one frame as a file;
    atomically.

    Args:
        clip: (frame, Gaussians) of all frames, as `play` yields them.
        output: a folder that does not exist, or for one frame a file with a name that ends in
            `suffix`.
        suffix: of the files, e.g. ``.ply``.
        write: function that writes the Gaussians of one frame.
        frames: indices of the frames, ascending.
        progress: called with (files done, total number of files).

    Raises:
        ValueError: a broken packet, or several frames for one file.
        OSError: the folder exists, or a file cannot be written.
    """
    selection = set(frames)
    # The clip is read up to the last of the frames.
    chosen = islice((frame for frame in clip if frame[0] in selection), len(selection))
    is_file = Path(output).name.lower().endswith(suffix)
    with frame_files(output, is_file, suffix, "write_each()") as file_of:
        for count, (frame, gaussians) in enumerate(chosen, start=1):
            write(file_of(frame), gaussians)
            progress(count, len(selection))


def flight(
    stream: FrameSource,
    path: CameraPath,
    channels: Sequence[str] | None = ("color",),
    clip: Iterator[Gaussians] | None = None,
) -> Iterator[tuple[int, Arrays]]:
    """Render a stream along a camera path, at the stream's frame rate.

    Args:
        stream: the file.
        path: the moving camera; it determines the number of images, see `num_images`.
        channels: as for `render_stream`; None for `available_channels`.
        clip: Gaussians of each image; None: `repeated_frames`.

    Yields:
        (i, images): per channel an array [H, W, C], as `render_stream`.

    Raises:
        ValueError: an unknown channel, or a broken packet.
    """
    config = render_config(stream)
    frame_numbers(stream)  # refuses a stream without frames
    frames = islice(clip or repeated_frames(stream), num_images(stream, path))
    for i, gaussians in enumerate(frames):
        camera = path.at(i / stream.fps)
        yield i, render(gaussians, camera, channels or available_channels(gaussians), config)


def num_images(stream: FrameSource, path: CameraPath) -> int:
    """Return the number of images of `flight`."""
    return max(1, round(path.seconds * stream.fps))


def named_path(
    stream: FrameSource,
    name: str = "orbit",
    degrees: float | None = None,
    least_seconds: float = 5.0,
) -> CameraPath:
    """Return the camera path `between` or `orbit`, as long as the clip, or the path in a JSON file.

    Args:
        stream: the file.
        name: of the path or the file.
        degrees: angle of an orbit, see `orbit`; by default 60 for Gaussians without a recording.
        least_seconds: a shorter clip is played as often as it takes.

    Raises:
        FileNotFoundError, ValueError: as `through_cameras`, `orbit` and `load_path`, or
            `least_seconds` is negative or not finite.
    """
    check_number("named_path()", "least_seconds", least_seconds, "[0, inf)")
    clip = len(frame_numbers(stream)) / stream.fps
    clip *= max(1, math.ceil(least_seconds / clip - 1e-9))
    # An image is behind the Gaussians in the view of its camera alone.
    cameras = [replace(camera, background=None) for camera in stream.cameras]
    if name == "between":
        return through_cameras(cameras, clip)
    if name == "orbit":
        if degrees is None and stream.metadata.get(DEFAULT_RIG) is True:
            degrees = _SWING
        means = next(gaussians for _, gaussians in play(stream)).numpy()["means"]
        return orbit(cameras, focus(cameras, means), degrees, clip)
    origin = stream_origin(stream)
    path = load_path(name, cameras[0])
    return replace(path, keys=tuple(key.relative_to(origin) for key in path.keys))


def repeated_frames(stream: FrameSource, freeze: int | None = None) -> Iterator[Gaussians]:
    """Yield the frames of a stream without end.

    Args:
        stream: the file.
        freeze: index of a single frame to yield; None: all.

    Raises:
        ValueError: the stream has no such frame, or a packet is broken.
    """
    if freeze is not None:
        yield from repeat(stream.seek(freeze).gaussians)
    while True:
        yield from (gaussians for _, gaussians in play(stream))
