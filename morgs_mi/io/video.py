"""Readers of video files and of folders of images.

A frame is an RGB array [H, W, 3]: uint8 in sRGB, or of an EXR file float32 in linear light.
`VideoReader` and `FolderReader` have the same members.

Many cameras, above all in phones, record at a variable frame rate: they delay or leave out frames.
The container stores the time of each frame, so the reader knows where on a regular clock the frames
lie.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from morgs_mi.core.bounded import check_claim
from morgs_mi.io.exr import read_light
from morgs_mi.io.frame_times import SAME_TIME, clock, read_header, seconds, true_rate
from morgs_mi.io.image_size import image_size
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, images_in
from morgs_mi.io.numbering import counting_together

# Bytes of memory that a pixel takes, in BGR and RGB.
_BYTES_PER_PIXEL = 6
# First frame that is worth a search, and the frames before it at which the search aims: those shown
# right after a keyframe may refer to frames before it, and a file may be indexed by the times of
# decoding.
FAR = 100
_BEFORE = 32
# Frames that a clip may pause; the instants of the pause are listed.
_MAX_PAUSE = 1_000_000


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that places cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with
    # int.
    return [int(piece) if i % 2 else piece for i, piece in enumerate(re.split(r"([0-9]+)", name))]


def numbering_gap(names: Sequence[str]) -> int | None:
    """Return the index of the first name with a last number that does not continue the sequence, or
    None.
    """
    numbers = [int((re.findall(r"[0-9]+", name) or ["-1"])[-1]) for name in names]
    if len(names) < 2:
        return None
    steps = np.diff(numbers)
    least = steps.min()
    if min(numbers) >= 0 and least >= 1 and least == steps.max():
        return None
    return 1 + int(np.argmax(steps != least) if least > 0 else np.argmin(steps))


@dataclass(frozen=True)
class VideoReader:
    """Reader of a video file.

    Each call of `frames` or `pick` decodes from the start, or far from there from the last keyframe
    before, see `pick`.
    """

    path: Path  #: The file.
    num_frames: int  #: Number of frames according to the file's header.
    fps: float | None  #: Frames per second, None if unknown.
    width: int  #: In pixels.
    height: int  #: In pixels.
    num_held: int  #: Number of frames in the file; less than `num_frames` if it was truncated.
    #: Times of the frames in the file, in frames of a regular clock of rate `fps`, which shows
    #: position k at the time of frame k of a clip of constant rate [num_held]; None at a constant
    #: rate.
    positions: np.ndarray | None = field(default=None, compare=False)
    #: Times of the frames in the file, ascending, s [num_held]; None if it does not store them.
    times: np.ndarray | None = field(default=None, compare=False, repr=False)
    has_light: ClassVar[bool] = False

    @classmethod
    def open(cls, path: str | Path) -> VideoReader:
        """Return the reader of a video; the first frame is decoded.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is empty, OpenCV cannot decode it, or its time stamps are broken.
        """
        path = Path(path)
        header = read_header(path)
        num_held = header.num_held
        fps = header.fps
        times = header.times
        positions = None
        # Some containers do not store the number, and a frame takes more than a byte.
        num_frames = header.num_frames if 0 < header.num_frames <= path.stat().st_size else num_held
        if times is not None and len(times) > 1:
            periods = len(times) - 1.0
            if (regular := clock(times)) is not None:
                positions, rate = regular
                periods = float(positions[-1] - positions[0])
                _check_span(path, positions, rate, times)
                # Where the number is not stored, it is the duration times the mean rate; a clip of
                # this length is complete.
                if fps > 0 and num_frames / fps <= times[-1] + 1.5 / rate:
                    num_frames = num_held
            fps = true_rate(fps, periods, float(times[-1] - times[0]))
        shown_fps = fps if fps > 0 else None
        size = header.width, header.height
        return cls(path, num_frames, shown_fps, *size, num_held, positions, times)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1, by default up to `num_frames`.

        Raises:
            ValueError: a frame before `stop` cannot be decoded.
        """
        return _raising(
            self.pick(range(start, self.num_frames if stop is None else min(stop, self.num_frames)))
        )

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames of ascending `indices`, with an error in place of each that cannot be
        decoded.

        The frames between are decoded too. Those before the first are skipped if the time stamps of
        the frames that are decoded instead prove which ones they are. The pixels are the same as
        after decoding from the start, except in streams that refresh their images gradually instead
        of with keyframes.
        """
        stream, done = self._opened_before(indices[0]) if len(indices) else (self._opened(), 0)
        ok = True
        try:
            for index in indices:
                while ok and done <= index:
                    ok = stream.grab()
                    done += ok
                frame = stream.retrieve()[1] if ok else None
                yield (
                    self._missing(index if ok else done)
                    if frame is None
                    else cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
                )
        finally:
            stream.release()

    def _opened(self) -> cv2.VideoCapture:
        return cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)

    def _opened_before(self, index: int) -> tuple[cv2.VideoCapture, int]:
        """Return the decoder of the file, and the number of frames that it has passed: none, or all
        up to `index`.
        """
        if self.times is None or not FAR <= index < len(self.times):
            return self._opened(), 0
        stream = self._opened()
        stream.set(cv2.CAP_PROP_POS_MSEC, 1000 * self.times[index - _BEFORE])
        if _passes(stream, self.times, index):
            return stream, index + 1
        stream.release()
        return self._opened(), 0

    def _missing(self, index: int) -> ValueError:
        if index >= self.num_frames:
            return ValueError(
                f"{self.path}: it has ended after {self.num_frames} frames; record longer."
            )
        return ValueError(
            f"{self.path}: frame {index} of {self.num_frames} cannot be decoded: the file is "
            f"truncated or broken; copy it again or use the first {index} frames (`max_frames`)."
        )


@dataclass(frozen=True)
class FolderReader:
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
    #: Numbers of the images, None of a list of files and of a single image without a number.
    numbers: range | None = None

    @classmethod
    def open(cls, path: str | Path) -> FolderReader:
        """Return the reader of a folder's images in the order of their numbers; the first is
        decoded.

        Raises:
            FileNotFoundError: the folder or the images are missing.
            ValueError: a number is missing or occurs twice, or the first image cannot be decoded.
        """
        path = Path(path)
        files = _images(path)
        _check_gaps(path, files)
        return replace(cls.of_files(files), numbers=_numbers(files))

    @classmethod
    def of_files(cls, files: Sequence[Path], gaps: bool = False) -> FolderReader:
        """Return the reader of the images `files`; the first is decoded, with `gaps` the first that
        is readable.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: there are none, or the first cannot be decoded.
        """
        _check_files(files, gaps)
        first = _read_image(_first_readable(files) if gaps else files[0])
        return cls(files[0].parent, tuple(files), first.shape[1], first.shape[0])

    @property
    def num_frames(self) -> int:
        """Number of images."""
        return len(self.files)

    num_held = num_frames

    @property
    def has_light(self) -> bool:
        """Whether the images are EXR files, which have linear light."""
        return self.files[0].suffix.lower() == EXR_SUFFIX

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1.

        Raises:
            ValueError: an image cannot be decoded or has another size than the first.
        """
        return _raising(self.pick(range(self.num_frames)[start:stop]))

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames `indices`, with an error in place of each that is missing, broken or of
        another size.
        """
        yield from map(self._frame, indices)

    def _frame(self, index: int) -> ImageOrError:
        if index >= self.num_frames:
            return ValueError(
                f"{self.path}: it has ended after {self.num_frames} images; record longer."
            )
        frame = _image_or_error(self.files[index])
        if isinstance(frame, np.ndarray) and frame.shape[:2] != (self.height, self.width):
            return self._size_error(index, frame)
        return frame

    def _size_error(self, index: int, frame: np.ndarray) -> ValueError:
        return ValueError(
            f"{self.files[index]}: expected {self.width}x{self.height} as in "
            f"{self.files[0].name}, got {frame.shape[1]}x{frame.shape[0]}; extract the "
            "frames again."
        )


def _check_files(files: Sequence[Path], gaps: bool) -> None:
    if not files:
        raise ValueError(
            "FolderReader.of_files(): expected at least one image, got none; list the frames."
        )
    if not gaps and (missing := next((f for f in files if not f.is_file()), None)):
        raise _no_image(missing)


def _check_gaps(path: Path, files: Sequence[Path]) -> None:
    if gap := numbering_gap([f.stem for f in files]):
        raise ValueError(
            f"{path}: the images must be numbered without gaps, got {files[gap - 1].name} "
            f"followed by {files[gap].name}; extract the frames again, or go on without the "
            "missing ones (--gaps)."
        )


def _first_readable(files: Sequence[Path]) -> Path:
    """Return the first image that is readable, or the first file if none is."""
    readable = (file for file in files if not isinstance(_image_or_error(file), Exception))
    return next(readable, files[0])


def _passes(stream: cv2.VideoCapture, times: np.ndarray, index: int) -> bool:
    """Decode up to frame `index`, and return whether the frames on the way have their `times`."""
    if not stream.grab():
        return False
    at = int(np.argmin(np.abs(times - seconds(stream))))
    while at <= index and abs(times[at] - seconds(stream)) < SAME_TIME:
        if at == index:
            return True
        at += 1
        if not stream.grab():
            break
    return False


def _check_span(path: Path, positions: np.ndarray, rate: float, times: np.ndarray) -> None:
    """Check that a clip does not pause for more frames than could be listed."""
    if positions[-1] > 10 * len(times) + _MAX_PAUSE:
        raise ValueError(
            f"{path}: expected {len(times)} frames at about {rate:.3g} per second, got time stamps "
            f"that span {times[-1]:.3g} s; they are broken, convert the clip."
        )


FrameReader = VideoReader | FolderReader
Clip = Path | tuple[Path, ...]
"""A video file, a folder of images, or a list of image files."""
ImageOrError = np.ndarray | ValueError | FileNotFoundError
"""A frame, or the reason why it is missing."""


def open_clips(clips: Sequence[Clip], gaps: bool = False) -> list[FrameReader]:
    """Return one reader per camera; with `gaps`, images may be missing or broken.

    Folders that count together (see `counting_together`) are then aligned by the numbers of their
    images: a number that only others have is a missing image.

    Raises:
        FileNotFoundError: a clip is missing, or one of its images.
        ValueError: as `VideoReader.open` and `FolderReader.open`.
    """
    readers = _aligned_folders(
        [clip for clip in clips if gaps and isinstance(clip, Path) and clip.is_dir()]
    )
    return [readers[clip] if clip in readers else open_frames(clip, gaps) for clip in clips]


def _aligned_folders(folders: Sequence[Path]) -> dict[Clip, FrameReader]:
    """Return the readers of folders of images, aligned by the numbers of their images."""
    folder_files = {
        folder: {image_number(file): file for file in _images(folder)} for folder in folders
    }
    ascending = {folder: sorted(files) for folder, files in folder_files.items()}
    readers: dict[Clip, FrameReader] = {}
    for group in counting_together(ascending):
        numbers = _instants([folder_files[folder] for folder in group])
        for folder in group:
            files = folder_files[folder]
            images = [files.get(number, _missing_name(folder, files, number)) for number in numbers]
            readers[folder] = replace(FolderReader.of_files(images, gaps=True), numbers=numbers)
    return readers


def _instants(group: Sequence[Mapping[int, Path]]) -> range:
    """Return the numbers of the instants of folders that count together, given by their images by
    number.

    Raises:
        ValueError: there are far more than images.
    """
    numbers = sorted(set().union(*group))
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    if (numbers[-1] - numbers[0]) // step > 10 * len(numbers) + 1000:
        raise _gap_error(group, numbers)
    return range(numbers[0], numbers[-1] + 1, step)


def _gap_error(group: Sequence[Mapping[int, Path]], numbers: Sequence[int]) -> ValueError:
    """Return the error of the largest gap in the numbers of images."""
    gap = int(np.argmax(np.diff(numbers)))
    file = next(files[numbers[gap + 1]] for files in group if numbers[gap + 1] in files)
    return ValueError(
        f"{file}: expected images numbered without large gaps, got this after "
        f"number {numbers[gap]} among {len(numbers)} images; rename or remove it."
    )


def open_frames(path: str | Path | tuple[Path, ...], gaps: bool = False) -> FrameReader:
    """Return the reader of a video file, a folder of images or a list of images; raises the errors
    of their `open`.

    With `gaps`, images of a list may be missing or broken.
    """
    if isinstance(path, tuple):
        return FolderReader.of_files(path, gaps)
    return FolderReader.open(path) if Path(path).is_dir() else VideoReader.open(path)


def _raising(images: Iterator[ImageOrError]) -> Iterator[np.ndarray]:
    for image in images:
        if isinstance(image, Exception):
            raise image
        yield image


def _images(path: Path) -> list[Path]:
    """Return a folder's images in the order of their numbers."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a folder of images, found none; check the path.")
    files = sorted(images_in(path), key=lambda f: natural_key(f.stem))
    if not files:
        raise FileNotFoundError(
            f"{path}: expected images ({', '.join((*IMAGE_SUFFIXES, EXR_SUFFIX))}), found none; "
            "extract the frames."
        )
    return files


def _numbers(files: Sequence[Path]) -> range | None:
    """Return the numbers of images without gaps, None of a single image without a number."""
    if len(files) == 1 and not re.search(r"[0-9]", files[0].stem):
        return None
    first = image_number(files[0])
    step = image_number(files[1]) - first if len(files) > 1 else 1
    return range(first, first + step * len(files), step)


def image_number(file: Path) -> int:
    """Return the last number in the name of an image.

    Raises:
        ValueError: there is none.
    """
    numbers = re.findall(r"[0-9]+", file.stem)
    if not numbers:
        raise ValueError(
            f"{file}: expected an image whose name ends in a number, got none; extract the frames "
            "again."
        )
    return int(numbers[-1])


def _missing_name(folder: Path, files: Mapping[int, Path], number: int) -> Path:
    """Return the path that a missing image would have."""
    other = next(iter(files.values()))
    return folder / re.sub(
        r"[0-9]+(?=[^0-9]*\.)", lambda old: str(number).zfill(len(old[0])), other.name, count=1
    )


def _no_image(file: Path) -> FileNotFoundError:
    return FileNotFoundError(
        f"{file}: expected an image, found none; extract the frames again, or go on without it "
        "(--gaps)."
    )


def _image_or_error(file: Path) -> ImageOrError:
    try:
        return _read_image(file)
    except (ValueError, FileNotFoundError) as error:
        return error


def _read_image(file: Path) -> np.ndarray:
    if not file.is_file():
        raise _no_image(file)
    if file.suffix.lower() == EXR_SUFFIX:
        return _read_light(file)
    # The stored pixels, without EXIF's rotation: calibrations refer to them.
    image = decode_image(file, cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _read_light(file: Path) -> np.ndarray:
    try:
        return read_light(file)
    except OSError as error:
        raise ValueError(str(error)) from None


def decode_image(file: Path, mode: int) -> np.ndarray:
    """Return the image in a file, decoded by OpenCV with `mode`.

    Args:
        file: the file.
        mode: of `cv2.imdecode`.

    Raises:
        ValueError: it is no image, or claims more pixels than the file may hold.
    """
    data = np.fromfile(file, np.uint8)
    width, height = image_size(data)
    check_claim(file, _BYTES_PER_PIXEL * width * height, f"{width}x{height} pixels")
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    if image is None:
        raise ValueError(
            f"{file}: expected an image, got {len(data)} bytes that cannot be decoded."
        )
    return image
