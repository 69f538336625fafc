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
import re
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
from morgs_mi.io.exr import read_light
from morgs_mi.io.frame_times import clock, true_rate
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, existing_file, images_in
from morgs_mi.io.numbering import check_numbering, counting_together, frame_numbers

if TYPE_CHECKING:
    import av  # imported where a video is opened, as it takes 80 ms
    import av.container

_Item = TypeVar("_Item")
# Bytes of memory that a pixel takes, in BGR and RGB.
_BYTES_PER_PIXEL = 6
# White of images of 16 bits, and the bits of cameras that are stored in them.
_WHITE = 2**16 - 1
_BITS = (8, 10, 12, 14)
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


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that places cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with
    # int.
    return [int(piece) if i % 2 else piece for i, piece in enumerate(re.split(r"([0-9]+)", name))]


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
    width: int  #: In pixels, after the rotation that the file asks for.
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
    has_light: ClassVar[bool] = False

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
            width, height = (first.width, first.height)[:: 1 if first.rotation % 180 == 0 else -1]
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
        return cls(path, num_frames, fps or None, width, height, num_held, positions, stamps, times)

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
                # Of 10 bits, BGR has half the error of RGB. Starting threads takes 1 ms a frame.
                bgr = converter.reformat(
                    frame, format="bgr24", interpolation="BICUBIC", threads=1
                ).to_ndarray()
                image = cv2.cvtColor(np.rot90(bgr, frame.rotation // 90), cv2.COLOR_BGR2RGB)
                yield (
                    image
                    if image.shape[:2] == (self.height, self.width)
                    else ValueError(
                        f"{self.path}: frame {target}: expected {self.width}x{self.height}, "
                        f"got {image.shape[1]}x{image.shape[0]}; convert the clip to one size."
                    )
                )

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
        container = av.open(f"file:{path}")  # a colon in the path would name a protocol
    except FFmpegError as error:
        raise _unreadable(path, str(error.strerror)) from None
    with container:
        stream = container.streams.best("video")
        if not isinstance(stream, av.VideoStream) or stream.codec_context is None:
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
    white: int = _WHITE  #: Value of white in images of 16 bits.

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
        first = _read_image(next(readable, files[0]))
        most = int(first.max()) if first.dtype == np.uint16 else None
        return cls(files[0].parent, tuple(files), first.shape[1], first.shape[0], most=most)

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
            elif frame.dtype != np.uint16:
                yield frame
            elif frame.max() > self.white:
                yield ValueError(
                    f"{file}: expected values up to {self.white} as in the first images, got "
                    f"{frame.max()}; convert the images to 8 bits."
                )
            else:
                yield cv2.convertScaleAbs(frame, alpha=255 / self.white)


FrameReader = VideoReader | FolderReader
Clip = Path | tuple[Path, ...]
"""A video file, a folder of images, or a list of image files."""
ImageOrError = np.ndarray | ValueError | FileNotFoundError
"""A frame, or the reason why it is missing."""


def open_clips(clips: Sequence[Clip], gaps: bool = False) -> list[FrameReader]:
    """Return one reader per camera; with `gaps`, images may be missing or broken.

    Folders that count together (see `counting_together`) are then aligned by the numbers of their
    images: a number that only others have is a missing image.

    Images of 16 bits may hold the values of fewer, see `_with_white`.

    Raises:
        FileNotFoundError: a clip is missing, or one of its images.
        ValueError: as `VideoReader.open` and `FolderReader.open`.
    """
    readers = _aligned_folders(
        [clip for clip in clips if gaps and isinstance(clip, Path) and clip.is_dir()]
    )
    return _with_white(
        [readers[clip] if clip in readers else open_frames(clip, gaps) for clip in clips]
    )


def _with_white(readers: list[FrameReader]) -> list[FrameReader]:
    """Return readers with the white of images of 16 bits, which may hold the 8, 10, 12 or 14 bits
    of cameras.

    They do if the first images have no larger value, and the brightest camera nearly the largest.
    A dark image of 16 bits has it by chance only. Cameras that disagree, or no such value, are
    reported: a dark image cannot be distinguished.
    """
    folders = [r for r in readers if isinstance(r, FolderReader) and r.most is not None]
    values = [folder.most or 0 for folder in folders]
    most = max(values, default=_WHITE)
    if most >= 2 ** max(_BITS):
        return readers
    # The upper sixteenth of the values, as highlights are.
    bits = [b for b in _BITS if any(15 * 2**b <= 16 * value < 16 * 2**b for value in values)]
    place = f"{folders[0].path} and the other cameras: images of 16 bits have values up to {most}"
    if len(bits) != 1 or most >= 2 ** bits[0]:
        _LOG.warning(
            "%s of %d and are nearly black; if white is less, multiply them.", place, _WHITE
        )
        return readers
    white = 2 ** bits[0] - 1
    _LOG.warning(
        "%s and are read as %d bits; if white is %d, convert them to 8 bits.",
        place,
        bits[0],
        _WHITE,
    )
    return [replace(r, white=white) if isinstance(r, FolderReader) else r for r in readers]


def _aligned_folders(folders: Sequence[Path]) -> dict[Clip, FrameReader]:
    """Return the readers of folders of images, aligned by the numbers of their images.

    Raises:
        ValueError: there are far more timestamps than images.
    """
    files_by_number = {folder: _images(folder) for folder in folders}
    readers: dict[Clip, FrameReader] = {}
    for group in counting_together({f: sorted(files) for f, files in files_by_number.items()}):
        clips = [files_by_number[folder] for folder in group]
        numbers = sorted(set().union(*clips))
        steps = np.diff(numbers)
        step = math.gcd(*steps.tolist()) or 1
        if (numbers[-1] - numbers[0]) // step > 10 * len(numbers) + 1000:
            gap = int(np.argmax(steps))
            file = next(files[numbers[gap + 1]] for files in clips if numbers[gap + 1] in files)
            raise ValueError(
                f"{file}: expected numbers without large gaps, got this one after {numbers[gap]}; "
                "remove or renumber it."
            )
        timestamps = range(numbers[0], numbers[-1] + 1, step)
        for folder, files in zip(group, clips, strict=True):
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
    files = sorted(images_in(path) if path.is_dir() else [], key=lambda f: natural_key(f.stem))
    if not files:
        suffixes = ", ".join((*IMAGE_SUFFIXES, EXR_SUFFIX))
        raise FileNotFoundError(f"{path}: expected images ({suffixes}), found none; extract them.")
    return dict(zip(frame_numbers(path, [file.stem for file in files]), files, strict=True))


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
        ValueError: it is no image, or claims more pixels than the file may hold.
    """
    data = np.fromfile(file, np.uint8)
    width, height = imagesize.get(file)  # -1 where the header does not show it
    check_claim(file, _BYTES_PER_PIXEL * width * height, f"{width}x{height} pixels")
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    if image is None:
        raise ValueError(
            f"{file}: expected an image, got {len(data)} bytes of another kind; copy it again."
        )
    return image
