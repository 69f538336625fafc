"""Readers of video files and of folders of images.

A frame is an RGB array [H, W, 3]: uint8 in sRGB, or of an EXR file float32 in linear light.
`VideoReader` and `FolderReader` have the same members.

Many cameras, above all in phones, record at a variable frame rate: they delay or leave out frames.
The container stores the time of each frame, so the reader knows where on a regular clock the frames
lie.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from sys import maxsize
from typing import TYPE_CHECKING, ClassVar, TypeVar

import cv2
import imagesize
import numpy as np

from morgs_mi.core.bounded import check_claim
from morgs_mi.core.checks import errors_at
from morgs_mi.core.png import has_whole_chunks
from morgs_mi.io.exr import read_light
from morgs_mi.io.frame_times import clock, time_code_seconds, true_rate
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, by_stem, existing_file, images_in
from morgs_mi.io.numbering import (
    check_counting,
    check_numbering,
    frame_numbers,
    natural_key,
)

if TYPE_CHECKING:
    import av  # imported where a video is opened, as it takes 80 ms
    import av.container
    from av.video.reformatter import VideoReformatter

_Item = TypeVar("_Item")
# Bytes of memory that a pixel takes, in BGR and RGB.
_BYTES_PER_PIXEL = 6
WHITE = 2**16 - 1
"""White of images of 16 bits, unless a capture sets another one."""
# FFmpeg's readers of videos. None of them opens the files that a text names, as that of play lists
# does.
_CONTAINERS = {
    "format_whitelist": "mov,matroska,avi,mpegts,mpeg,flv",
    "protocol_whitelist": "file",
}
# Colours that are not converted, by their codes in ITU-T H.273.
_TRANSFERS = {16: "PQ", 18: "HLG"}
_PRIMARIES = {9: "BT.2020", 12: "Display P3"}
# What a file is expected to be, and the remedy if there is none.
_IMAGE = ("an image", "extract the frames again, or go on without it (--gaps)")
_LOG = logging.getLogger(__name__)
# First frame that is worth a search, and the frames before it at which the search aims: those shown
# right after a keyframe may refer to frames before it, and a file may be indexed by the times of
# decoding.
FAR = 100
_BEFORE = 32
# Frames that a clip may pause; the timestamps of the pause are listed.
_MAX_PAUSE = 1_000_000


class _Frames:
    """The members that the readers share."""

    num_frames: int

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        raise NotImplementedError

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1, by default up to `num_frames`.

        Raises:
            ValueError: a frame cannot be decoded or has another size than the first.
            FileNotFoundError: an image is missing.
        """
        for image in self.pick(range(self.num_frames)[start:stop]):
            if isinstance(image, Exception):
                raise image
            yield image


@dataclass(frozen=True)
class VideoReader(_Frames):
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
        with _opened(path) as (container, stream):
            num_indexed = len(stream.index_entries)
            hidden = sum(entry.is_discard for entry in stream.index_entries)
            first = None
            packets = []
            for packet in _unbroken(partial(container.demux, stream)):
                if first is None:
                    first = next(_unbroken(packet.decode), None)
                if packet.size:
                    packets.append((packet.pts, packet.is_discard, packet.is_corrupt))
            if first is None:
                raise _unreadable(path, "no frame can be decoded")
            with errors_at(path):
                height, width = _shown(np.empty((first.height, first.width)), first).shape
            fps = float(stream.guessed_rate or 0)
            shown = [time for time, is_hidden, is_cut in packets if not (is_hidden or is_cut)]
            # Without stamps, if a packet has none, or two have the same.
            stamps = None
            present = {time for time in shown if time is not None}
            if first.pts is not None and len(present) == len(shown):
                stamps = np.array(sorted(t for t in present if t >= first.pts), np.int64)
            num_held = len(shown if stamps is None else stamps)
            num_frames = stream.frames - hidden if stream.frames else 0
            if num_indexed == len(packets) and not any(is_cut for *_, is_cut in packets):
                num_frames = num_held  # headers also count what edit lists and null frames hide
            length = _length(container, stream, first)
            unit = float(stream.time_base or 0)
            # AVI has no others; of some codecs, FFmpeg finds those of the frames.
            are_of_decoding = (
                container.format.name == "avi"
                and stream.codec_context.has_b_frames
                and shown == sorted(shown, key=lambda time: time or 0)
            )
            start = time_code_seconds(_time_code(container), fps)
            is_deep = first.format.components[0].bits == 16
            most = int(first.to_ndarray(format="rgb48le").max()) if is_deep else None
            notes = tuple(_unused_properties(container, stream, first))
        positions = times = None
        if stamps is not None and num_held > 1:
            times = (stamps - stamps[0]) * unit
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
            if not num_frames and length * fps > periods + 1.5:
                num_frames = round(length * fps)
        if not num_held <= num_frames <= path.stat().st_size:  # a frame takes more than a byte
            num_frames = num_held
        return cls(
            path,
            num_frames,
            fps or None,
            width,
            height,
            num_held,
            positions,
            # Decoded frames are in order, but have each other's times.
            None if are_of_decoding else stamps,
            times,
            start,
            most,
            notes=notes,
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
                        f"{missing} frames (`max_frames`)."
                    )
                    continue
                try:
                    image = self._image(frame, converter)
                except ValueError as error:
                    image = ValueError(f"{self.path}: frame {target}: {error}.")
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
        image = cv2.cvtColor(_shown(_eight_bits(bgr, self.white), frame), cv2.COLOR_BGR2RGB)
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"expected {self.width}x{self.height}, got {image.shape[1]}x{image.shape[0]}; "
                "convert the clip to one size"
            )
        return image

    def _numbered(self, first: int) -> Generator[tuple[int, av.VideoFrame], None, None]:
        """Yield the frames with their indices, from `first` or earlier."""
        stamps = self.stamps
        far = stamps is not None and FAR <= first < len(stamps)
        for begin in (first - _BEFORE, 0) if far else (0,):
            # All frames are missing if the file has vanished since it was opened.
            with suppress(FileNotFoundError, ValueError), _opened(self.path) as (container, stream):
                if stamps is not None and begin:
                    container.seek(int(stamps[begin]), stream=stream)
                packets = _unbroken(partial(container.demux, stream))
                frames = (frame for packet in packets for frame in _unbroken(packet.decode))
                numbered = enumerate(frames)
                if stamps is not None:
                    # A frame of a damaged packet is none of those that the file holds.
                    indices = {int(stamp): index for index, stamp in enumerate(stamps)}
                    numbered = ((indices[f.pts], f) for f in frames if f.pts in indices)
                head = next(numbered, None)
                if head is not None and (head[0] <= first or not begin):
                    yield head
                    yield from numbered
                    return


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
    end = 0.0
    if text := stream.metadata.get("DURATION"):  # Matroska: hours:minutes:seconds
        with suppress(ValueError):
            end = float(np.dot([3600, 60, 1], [float(part) for part in text.split(":")]))
    elif container.duration and len(container.streams) == 1:  # otherwise of the sound
        end = container.duration / 1e6
    return end - (first.time or 0) if np.isfinite(end) else 0


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
            f"[{a:g} {b:g}; {c:g} {d:g}]; convert the clip"
        )
    image = image if a else image.swapaxes(0, 1)
    return image[:: int(b + d), :: int(a + c)]


def _eight_bits(image: np.ndarray, white: int) -> np.ndarray:
    """Return an image of 16 bits with 8 bits, any other one as it is.

    Raises:
        ValueError: a value is above white.
    """
    if image.dtype != np.uint16:
        return image
    if image.max() > white:
        raise ValueError(
            f"expected values up to the `white` of capture.json, {white}, got {image.max()}; "
            "correct it"
        )
    return cv2.convertScaleAbs(image, alpha=255 / white)


def _unreadable(path: Path, reason: str) -> ValueError:
    return ValueError(
        f"{path}: expected a video, got {path.stat().st_size} bytes that FFmpeg cannot read "
        f"({reason}): the file is truncated, no video, or in a rare codec; copy it again, or "
        "convert it to H.264."
    )


@dataclass(frozen=True)
class FolderReader(_Frames):
    """Reader of a folder of numbered images, e.g. ``0000.png``, with the members of `VideoReader`,
    `fps` and `positions` being None.

    The images may also be a list of files in any folders; `path` is then the folder of the first.
    """

    path: Path
    files: tuple[Path, ...]
    width: int
    height: int
    fps: float | None = None
    positions: np.ndarray | None = None
    #: Numbers of the images, None of a list of files.
    numbers: range | None = None
    #: Largest value of the first image if it has 16 bits, otherwise None.
    most: int | None = None
    white: int = WHITE  #: Value of white in images of 16 bits.
    start: ClassVar[float] = np.nan
    notes: tuple[str, ...] = ()  #: A sentence for each property of the files that is not used.

    @classmethod
    def open(cls, path: str | Path) -> FolderReader:
        """Return the reader of a folder's images in the order of their numbers; the first is
        decoded.

        Raises:
            FileNotFoundError: the folder or the images are missing.
            ValueError: a number is missing or occurs twice, or the first image cannot be decoded.
        """
        path = Path(path)
        images = _images(path)
        files = list(images.values())
        numbers = list(images)
        check_numbering(path, numbers, [file.name for file in files])
        step = numbers[1] - numbers[0] if len(numbers) > 1 else 1
        return replace(cls.of_files(files), numbers=range(numbers[0], numbers[-1] + step, step))

    @classmethod
    def of_files(cls, files: Sequence[Path], gaps: bool = False) -> FolderReader:
        """Return the reader of the images `files`; the first is decoded, with `gaps` the first that
        is readable.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: the first cannot be decoded.
        """
        for file in () if gaps else files:
            existing_file(file, *_IMAGE)
        readable = (f for f in files if not (gaps and isinstance(_image_or_error(f), Exception)))
        file = next(readable, files[0])
        first = _read_image(file)
        height, width = first.shape[:2]
        most = int(first.max()) if first.dtype == np.uint16 else None
        notes = []
        if (pages := cv2.imcount(str(file))) > 1:
            notes = [f"images have {pages} pages, of which the first is used; extract all."]
        return cls(files[0].parent, tuple(files), width, height, most=most, notes=tuple(notes))

    @property
    def num_frames(self) -> int:
        """Number of images."""
        return len(self.files)

    num_held = num_frames

    @property
    def has_light(self) -> bool:
        """Whether the images are EXR files, which have linear light."""
        return self.files[0].suffix.lower() == EXR_SUFFIX

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames `indices`, with an error in place of each that is missing, broken or of
        another size.
        """
        for index in indices:
            if index >= self.num_frames:
                yield ValueError(
                    f"{self.path}: it has ended after {self.num_frames} images; record longer."
                )
                continue
            file = self.files[index]
            frame = _image_or_error(file)
            if isinstance(frame, Exception):
                yield frame
            elif frame.shape[:2] != (self.height, self.width):
                yield ValueError(
                    f"{file}: expected {self.width}x{self.height} as in {self.files[0].name}, got "
                    f"{frame.shape[1]}x{frame.shape[0]}; extract the frames again."
                )
            else:
                try:
                    yield _eight_bits(frame, self.white)
                except ValueError as error:
                    yield ValueError(f"{file}: {error}.")


FrameReader = VideoReader | FolderReader
Clip = Path | tuple[Path, ...]
"""A video file, a folder of images, or a list of image files."""
ImageOrError = np.ndarray | ValueError | FileNotFoundError
"""A frame, or the reason why it is missing."""


def open_clips(
    clips: Sequence[Clip], gaps: bool = False, white: int | None = None
) -> list[FrameReader]:
    """Return one reader per camera; with `gaps`, images may be missing or broken.

    Folders are then aligned by the numbers of their images: a number that only others have is a
    missing image.

    Without `white`, a warning names images of 16 bits that are nearly black, because cameras of 10
    or 12 bits may have written them.

    Args:
        clips: one per camera.
        gaps: whether images may be missing.
        white: value of white in images of 16 bits; None: the largest.

    Raises:
        FileNotFoundError: a clip is missing, or one of its images.
        ValueError: as `VideoReader.open` and `FolderReader.open`.
    """
    folders = _aligned_folders(
        [clip for clip in clips if gaps and isinstance(clip, Path) and clip.is_dir()]
    )
    readers = [folders[clip] if clip in folders else open_frames(clip, gaps) for clip in clips]
    largest = max(
        (reader.most or 0 for reader in readers if reader.most is not None), default=WHITE
    )
    if white is None and largest < WHITE // 4:
        _LOG.warning(
            "%s and the other cameras: the first images have 16 bits but no value above %d and are "
            "nearly black; if white is less than %d, such as 4095 of cameras with 12 bits, set "
            '"white": 4095 in capture.json.',
            readers[0].path,
            largest,
            WHITE,
        )
    return [replace(reader, white=white or WHITE) for reader in readers]


def _aligned_folders(folders: Sequence[Path]) -> dict[Clip, FrameReader]:
    """Return the readers of folders of images, aligned by the numbers of their images.

    Raises:
        ValueError: the numbers of a folder do not count, those of two do not overlap, or there are
            far more timestamps than images.
    """
    if not folders:
        return {}
    files_by_number = {folder: _images(folder) for folder in folders}
    for folder, files in files_by_number.items():
        check_counting(folder, [*files], [file.name for file in files.values()])
    first = max(map(min, files_by_number.values()))
    last = min(map(max, files_by_number.values()))
    if first > last:
        raise ValueError(
            f"{folders[0].parent}: expected cameras with numbers of images that overlap, got one "
            f"that ends with {last} and one that begins with {first}; pair their images by "
            "position with --offset in place of --gaps, or leave one out with --exclude."
        )
    numbers = sorted(set().union(*files_by_number.values()))
    steps = np.diff(numbers)
    step = math.gcd(*steps.tolist()) or 1
    if (numbers[-1] - numbers[0]) // step > 10 * len(numbers) + 1000:
        gap = int(np.argmax(steps))
        clips = files_by_number.values()
        file = next(files[numbers[gap + 1]] for files in clips if numbers[gap + 1] in files)
        raise ValueError(
            f"{file}: expected numbers without large gaps, got this one after {numbers[gap]}; "
            "remove or renumber it."
        )
    timestamps = range(numbers[0], numbers[-1] + 1, step)
    readers: dict[Clip, FrameReader] = {}
    for folder, files in files_by_number.items():
        suffix = next(iter(files.values())).suffix
        images = [files.get(n, folder / f"{n:04d}{suffix}") for n in timestamps]
        readers[folder] = replace(FolderReader.of_files(images, gaps=True), numbers=timestamps)
    return readers


def open_frames(path: str | Path | tuple[Path, ...], gaps: bool = False) -> FrameReader:
    """Return the reader of a video file, a folder of images or a list of images; raises the errors
    of their `open`.

    With `gaps`, images of a list may be missing or broken.
    """
    if isinstance(path, tuple):
        return FolderReader.of_files(path, gaps)
    return FolderReader.open(path) if Path(path).is_dir() else VideoReader.open(path)


def _images(path: Path) -> dict[int, Path]:
    """Return a folder's images by their numbers, in natural order."""
    images = by_stem(images_in(path) if path.is_dir() else [])
    names = sorted(images, key=natural_key)
    if not names:
        suffixes = ", ".join((*IMAGE_SUFFIXES, EXR_SUFFIX))
        raise FileNotFoundError(f"{path}: expected images ({suffixes}), found none; extract them.")
    return dict(zip(frame_numbers(path, names), (images[name] for name in names), strict=True))


def _image_or_error(file: Path) -> ImageOrError:
    try:
        return _read_image(file)
    except (ValueError, FileNotFoundError) as error:
        return error


def _read_image(file: Path) -> np.ndarray:
    existing_file(file, *_IMAGE)
    if file.suffix.lower() == EXR_SUFFIX:
        try:
            return read_light(file)
        except OSError as error:
            raise ValueError(str(error)) from None
    # The stored pixels, without EXIF's rotation: calibrations refer to them.
    image = decode_image(file, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{file}: expected 8 or 16 bits, got {image.dtype}; convert it.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def decode_image(file: Path, mode: int) -> np.ndarray:
    """Return the image in a file, decoded by OpenCV with `mode`.

    Args:
        file: the file.
        mode: of `cv2.imdecode`.

    Raises:
        ValueError: it is no image, is a truncated PNG, or claims more pixels than the file may
            hold.
    """
    data = np.fromfile(file, np.uint8)
    width, height = imagesize.get(file)  # -1 where the header does not show it
    check_claim(file, _BYTES_PER_PIXEL * width * height, f"{width}x{height} pixels")
    is_png = data[:4].tobytes() == b"\x89PNG"
    is_whole = has_whole_chunks(data.tobytes()) if is_png else len(data) > 0
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if is_whole else None
    if image is None:
        raise ValueError(
            f"{file}: expected an image, got {len(data)} bytes that are none, or a part of one; "
            "copy it again."
        )
    return image
