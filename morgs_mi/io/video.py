"""Reader of video files, with the members of `FolderReader`.

Many cameras, above all in phones, record at a variable frame rate: they delay or leave out frames.
The container stores the time of each frame, so the reader knows where on a regular clock the frames
lie.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from sys import maxsize
from typing import TYPE_CHECKING, ClassVar, TypeVar

import cv2
import numpy as np

from morgs_mi.io.frame_times import clock, time_code_seconds, true_rate
from morgs_mi.io.images import WHITE, Frames, ImageOrError, eight_bits
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.checks import errors_at

if TYPE_CHECKING:
    import av  # imported where a video is opened, as it takes 80 ms
    import av.container
    from av.video.reformatter import VideoReformatter

_Item = TypeVar("_Item")
# FFmpeg's readers of videos. None of them opens the files that a text names, as that of play lists
# does.
_CONTAINERS = {
    "format_whitelist": "mov,matroska,avi,mpegts,mpeg,flv",
    "protocol_whitelist": "file",
}
# Colours that are not converted, by their codes in ITU-T H.273.
_TRANSFERS = {16: "PQ", 18: "HLG"}
_PRIMARIES = {9: "BT.2020", 12: "Display P3"}
# First frame that is worth a search, and the frames before it at which the search aims: those shown
# right after a keyframe may refer to frames before it, and a file may be indexed by the times of
# decoding.
FAR = 100
_BEFORE = 32
# Frames that a clip may pause; the timestamps of the pause are listed.
_MAX_PAUSE = 1_000_000


@dataclass(frozen=True)
class VideoReader(Frames):
    """Reader of a video file.

    Each call of `frames` or `pick` decodes from the start, or far from there from a keyframe.
    """

    path: Path  #: The file.
    num_frames: int  #: Number of frames according to the file's header.
    fps: float | None  #: Frames per second, None if unknown.
    width: int  #: In pixels, after the rotation that the file requires.
    height: int  #: In pixels.
    num_held: int  #: Number of frames in the file; less than `num_frames` if it was truncated.
    #: Times of the frames in the file, in frames of a regular clock of rate `fps`, which shows
    #: position k at the time of frame k of a clip of constant rate [num_held]; None at a constant
    #: rate.
    positions: np.ndarray | None = field(default=None, compare=False)
    #: Times of the frames in the file, ascending, in units of the file [num_held]; None if it does
    #: not store them.
    stamps: np.ndarray | None = field(default=None, compare=False, repr=False)
    #: Times of the frames after the first, s [num_held]; None if the file does not store them.
    times: np.ndarray | None = field(default=None, compare=False, repr=False)
    start: float = np.nan  #: Time code of the first frame, s; NaN if there is none.
    most: int | None = None  #: As of `FolderReader`.
    white: int = WHITE  #: As of `FolderReader`.
    notes: tuple[str, ...] = ()  #: A sentence for each property of the file that is not used.
    has_light: ClassVar[bool] = False
    numbers: ClassVar[None] = None

    @classmethod
    def open(cls, path: str | Path) -> VideoReader:
        """Return the reader of a video; the first frame is decoded, and the packets are read.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is empty, FFmpeg cannot decode it, or its time stamps are broken.
        """
        path = Path(path)
        probe = _probe(path)
        fps = probe.fps
        num_held = probe.num_held
        num_frames = probe.num_frames
        positions = times = None
        if probe.stamps is not None and num_held > 1:
            times = (probe.stamps - probe.stamps[0]) * probe.time_unit
            periods = num_held - 1.0
            if (regular := clock(times)) is not None:
                positions, rate = regular
                periods = float(positions[-1] - positions[0])
                if positions[-1] > 10 * num_held + _MAX_PAUSE:
                    raise ValueError(
                        f"{path}: expected {num_held} frames at about {rate:.3g} fps, got times of "
                        f"{times[-1]:.3g} s; convert the clip."
                    )
            fps = true_rate(fps, periods, float(times[-1]))
            # A header may have the length of another stream's last packet.
            if not num_frames and probe.length * fps > periods + 1.5:
                num_frames = round(probe.length * fps)
        if not num_held <= num_frames <= path.stat().st_size:  # a frame takes more than a byte
            num_frames = num_held
        return cls(
            path,
            num_frames,
            fps or None,
            probe.width,
            probe.height,
            num_held,
            positions,
            # Decoded frames are in order, but have each other's times.
            None if probe.are_decoding_times else probe.stamps,
            times,
            probe.start,
            probe.most,
            notes=probe.notes,
        )

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames of ascending `indices`, with an error in place of each that cannot be
        decoded.

        The pixels are the same as after decoding from the start, except in streams that refresh
        their images gradually instead of with keyframes.
        """
        from av.video.reformatter import VideoReformatter

        numbered = self._numbered(indices[0] if len(indices) else 0)
        converter = VideoReformatter()
        last = index = -1
        frame = None
        with closing(numbered):
            for target in indices:
                while index < target:
                    last = index
                    index, frame = next(numbered, (maxsize, None))
                if frame is None or index > target:
                    missing = last + 1 if frame is None else target
                    yield ValueError(
                        f"{self.path}: it has ended after {self.num_frames} frames; record longer."
                        if missing >= self.num_frames
                        else f"{self.path}: frame {missing} of {self.num_frames} cannot be "
                        "decoded: the file is truncated or broken; copy it again or use the first "
                        f"{missing} frames (--frames)."
                    )
                    continue
                try:
                    image = self._image(frame, converter)
                except ValueError as error:
                    image = ValueError(f"{self.path}: frame {target}: {error}")
                yield image

    def _image(self, frame: av.VideoFrame, converter: VideoReformatter) -> np.ndarray:
        """Return the RGB image [H, W, 3] uint8 of a frame, as players show it.

        Raises:
            ValueError: it has another size than the first one, or brighter values than white.
        """
        # Of 10 bits, BGR has half the error of RGB. Starting threads takes 1 ms a frame.
        bgr = converter.reformat(
            frame,
            format="bgr24" if self.most is None else "bgr48le",
            interpolation="BICUBIC",
            threads=1,
        ).to_ndarray()
        image = cv2.cvtColor(_shown(eight_bits(bgr, self.white), frame), cv2.COLOR_BGR2RGB)
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"expected {self.width}x{self.height}, got {image.shape[1]}x{image.shape[0]}; "
                "convert the clip to one size."
            )
        return image

    def _numbered(self, first: int) -> Generator[tuple[int, av.VideoFrame], None, None]:
        """Yield the frames with their indices, from `first` or earlier."""
        if self.stamps is not None and FAR <= first < len(self.stamps):
            with closing(self._decoded(int(self.stamps[first - _BEFORE]))) as frames:
                head = next(frames, None)
                if head is not None and head[0] <= first:
                    yield head
                    yield from frames
                    return
        yield from self._decoded()

    def _decoded(
        self, begin: int | None = None
    ) -> Generator[tuple[int, av.VideoFrame], None, None]:
        """Yield the frames with their indices, from a keyframe at the time `begin` or earlier."""
        # All frames are missing if the file has vanished since it was opened.
        with suppress(FileNotFoundError, ValueError), _opened(self.path) as (container, stream):
            if begin is not None:
                container.seek(begin, stream=stream)
            packets = _unbroken(partial(container.demux, stream))
            frames = (frame for packet in packets for frame in _unbroken(packet.decode))
            if self.stamps is None:
                yield from enumerate(frames)
                return
            # A frame of a damaged packet is none of those that the file holds.
            indices = {int(stamp): index for index, stamp in enumerate(self.stamps)}
            yield from ((indices[frame.pts], frame) for frame in frames if frame.pts in indices)


@dataclass(frozen=True)
class _Probe:
    """What a video's header, packets and first frame say."""

    width: int  #: Of the first frame as players show it, in pixels.
    height: int  #: In pixels.
    fps: float  #: Frames per second as FFmpeg guesses them; 0 if unknown.
    num_frames: int  #: Number of frames that the header states; 0 without one.
    num_held: int  #: Number of frames that the packets hold.
    stamps: np.ndarray | None  #: As of `VideoReader`, or decoding times.
    time_unit: float  #: Seconds of a unit of the stamps.
    length: float  #: Seconds that the header states; 0 without them.
    are_decoding_times: bool  #: Whether the stamps are decoding times.
    start: float  #: Time code of the first frame, s; NaN if there is none.
    most: int | None  #: As of `FolderReader`.
    notes: tuple[str, ...]  #: As of `VideoReader`.


def _probe(path: Path) -> _Probe:
    """Return what a video says; the first frame is decoded, and the packets are read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is empty, or FFmpeg cannot decode it.
    """
    with _opened(path) as (container, stream):
        num_indexed = len(stream.index_entries)
        hidden = sum(entry.is_discard for entry in stream.index_entries)
        first = None
        num_packets = 0
        num_cut = 0
        shown = []  # times of the packets that are neither hidden nor cut
        for packet in _unbroken(partial(container.demux, stream)):
            if first is None:
                first = next(_unbroken(packet.decode), None)
            num_packets += packet.size > 0
            num_cut += packet.is_corrupt
            if packet.size and not (packet.is_discard or packet.is_corrupt):
                shown.append(packet.pts)
        if first is None:
            raise _unreadable(path, "no frame can be decoded")
        with errors_at(path):
            height, width = _shown(np.empty((first.height, first.width)), first).shape
        # Without stamps, if a packet has none, or two have the same.
        stamps = None
        if first.pts is not None and None not in shown:
            times = np.unique(np.array(shown, np.int64))
            if len(times) == len(shown):
                stamps = times[times >= first.pts]
        num_held = len(shown if stamps is None else stamps)
        num_frames = stream.frames - hidden if stream.frames else 0
        if num_indexed == num_packets and num_cut == 0:
            num_frames = num_held  # headers also count what edit lists and null frames hide
        # AVI stores decoding times alone.
        are_decoding_times = container.format.name == "avi" and stream.codec_context.has_b_frames
        fps = float(stream.guessed_rate or 0)
        is_deep = first.format.components[0].bits == 16
        return _Probe(
            width,
            height,
            fps,
            num_frames,
            num_held,
            stamps,
            float(stream.time_base or 0),
            _length(container, stream, first),
            are_decoding_times,
            time_code_seconds(_time_code(container), fps),
            int(first.to_ndarray(format="rgb48le").max()) if is_deep else None,
            tuple(_unused_properties(container, stream, first)),
        )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """Open a video file for reading, and find its stream of images."""
    import av
    from av.error import FFmpegError

    existing_file(path, "a video file")
    try:
        # A colon in the path would name a protocol.
        container = av.open(f"file:{path}", options=_CONTAINERS, metadata_errors="replace")
    except FFmpegError as error:
        raise _unreadable(path, str(error.strerror)) from None
    with container:
        stream = next(iter(_tracks(container)), None)
        if stream is None or stream.codec_context is None:
            raise _unreadable(path, "it has no images, or FFmpeg has no decoder for its codec")
        stream.thread_type = "AUTO"
        yield container, stream


def _unbroken(read: Callable[[], Iterable[_Item]]) -> Iterator[_Item]:
    """Yield what FFmpeg reads up to the first error: what cannot be decoded is missing."""
    from av.error import FFmpegError

    with suppress(FFmpegError):
        yield from read()


def _length(
    container: av.container.InputContainer, stream: av.VideoStream, first: av.VideoFrame
) -> float:
    """Return the time from the first frame to the end that a file states, s; 0 without one."""
    if stream.duration:
        return float(stream.duration * (stream.time_base or 0))
    if container.duration and len(container.streams) == 1:  # otherwise of the sound
        return container.duration / 1e6 - (first.time or 0)
    return 0.0


def _tracks(container: av.container.InputContainer) -> list[av.VideoStream]:
    """Return the tracks of images, of which players show the first, without cover pictures."""
    from av.stream import Disposition

    pictures = Disposition.attached_pic
    return [track for track in container.streams.video if not track.disposition & pictures]


def _time_code(container: av.container.InputContainer) -> str:
    """Return the time code of a clip's first frame, or an empty text."""
    metadata = [container.metadata, *(track.metadata for track in container.streams)]
    codes = (tags.get("timecode") or tags.get("TIMECODE") for tags in metadata)
    return next(filter(None, codes), "")


def _unused_properties(
    container: av.container.InputContainer, stream: av.VideoStream, frame: av.VideoFrame
) -> Iterator[str]:
    """Yield a sentence for each property of a video that is not used: other tracks, interlaced
    rows, and colours other than sRGB's.
    """
    first, *others = (
        track.metadata.get("title") or track.codec.name for track in _tracks(container)
    )
    if others:
        yield f"the first video track, {first}, is used, and not {', '.join(others)}."
    if frame.interlaced_frame:
        yield (
            "interlaced: each frame has the rows of two moments; deinterlace the clip (FFmpeg's "
            "filter bwdif) if things move."
        )
    names = (_TRANSFERS.get(frame.color_trc), _PRIMARIES.get(frame.color_primaries))
    if colors := " and ".join(filter(None, names)):
        yield f"colours of {colors} are used as those of sRGB; convert the clip to BT.709."


def _shown(image: np.ndarray, frame: av.VideoFrame) -> np.ndarray:
    """Return a frame's image [H, W, ...] turned and mirrored as its display matrix requires.

    Raises:
        ValueError: the matrix turns it by another angle than 90 degrees.
    """
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return image
    # Of (x, y) to (ax + cy, bx + dy), in units of 2^-16.
    (a, b, _), (c, d, _), _ = np.rint(np.frombuffer(matrix, np.int32).reshape(3, 3) / 2**16)
    if {abs(a), abs(b)} != {0, 1} or (abs(c), abs(d)) != (abs(b), abs(a)):
        raise ValueError(
            "expected a display matrix that mirrors or turns by 90, 180 or 270 degrees, got "
            f"[{a:g} {b:g}; {c:g} {d:g}]; convert the clip."
        )
    image = image if a else image.swapaxes(0, 1)
    return image[:: int(b + d), :: int(a + c)]


def _unreadable(path: Path, reason: str) -> ValueError:
    return ValueError(
        f"{path}: expected a video, got {path.stat().st_size} bytes that FFmpeg cannot read "
        f"({reason}): the file is truncated, no video, or in a rare codec; copy it again, or "
        "convert it to H.264."
    )
