"""Readers of video files and of folders of images.

A frame is an RGB uint8 array [H, W, 3]. `VideoReader` and `FolderReader` have the same members.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

__all__ = [
    "Clip",
    "FolderReader",
    "FrameReader",
    "ImageOrError",
    "VideoReader",
    "natural_key",
    "numbering_gap",
    "open_clips",
    "open_frames",
]

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that places cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with int.
    return [int(piece) if i % 2 else piece for i, piece in enumerate(re.split(r"([0-9]+)", name))]


def numbering_gap(names: Sequence[str]) -> int | None:
    """Return the index of the first name whose last number does not continue the sequence, or None."""
    numbers = [int((re.findall(r"[0-9]+", name) or ["-1"])[-1]) for name in names]
    steps = np.diff(numbers)
    if len(names) < 2 or (min(numbers) >= 0 and steps.min() >= 1 and steps.min() == steps.max()):
        return None
    return 1 + int(np.argmax(steps != steps.min()) if steps.min() > 0 else np.argmin(steps))


@dataclass(frozen=True)
class VideoReader:
    """Reader of a video file, which each call of `frames` decodes from the start.

    Attributes:
        path: the file.
        num_frames: number of frames according to the file's header.
        fps: frames per second, None if unknown.
        width: in pixels.
        height: in pixels.
        num_held: number of frames in the file; less than `num_frames` if it was truncated.
    """

    path: Path
    num_frames: int
    fps: float | None
    width: int
    height: int
    num_held: int

    @classmethod
    def open(cls, path: str | Path) -> VideoReader:
        """Return the reader of a video whose first frame can be decoded.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is empty or OpenCV cannot decode it.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: expected a video file, found none; check the path.")
        if path.stat().st_size == 0:
            raise ValueError(f"{path}: expected a video, got an empty file; copy or record it again.")
        stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        try:
            ok, first = stream.read()
            num_frames, fps = int(stream.get(cv2.CAP_PROP_FRAME_COUNT)), stream.get(cv2.CAP_PROP_FPS)
        finally:
            stream.release()
        if not ok:
            raise ValueError(
                f"{path}: expected a video, got {path.stat().st_size} bytes of which OpenCV cannot decode "
                "one frame: the file is truncated or no video; copy or convert it again."
            )
        held = _count_packets(path)
        # Some containers do not store the number.
        declared = num_frames if num_frames > 0 else held
        return cls(path, declared, fps if fps > 0 else None, first.shape[1], first.shape[0], held)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1, by default up to `num_frames`.

        Raises:
            ValueError: a frame before `stop` cannot be decoded.
        """
        return _raising(self.pick(range(start, self.num_frames if stop is None else min(stop, self.num_frames))))

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames of ascending `indices`, with an error in place of each that cannot be decoded.

        The frames between are decoded too, because seeking is inexact.
        """
        stream = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        done, ok = 0, True
        try:
            for index in indices:
                while ok and done <= index:
                    ok = stream.grab()
                    done += ok
                frame = stream.retrieve()[1] if ok else None
                yield self._missing(index if ok else done) if frame is None else cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        finally:
            stream.release()

    def _missing(self, index: int) -> ValueError:
        if index >= self.num_frames:
            return ValueError(f"{self.path}: it has ended after {self.num_frames} frames; record longer.")
        return ValueError(
            f"{self.path}: frame {index} of {self.num_frames} cannot be decoded: the file is truncated or broken; copy "
            f"it again or use the first {index} frames (`max_frames`)."
        )


@dataclass(frozen=True)
class FolderReader:
    """Reader of a folder of numbered images, e.g. ``0000.png``; the members of `VideoReader`, with `fps` None.

    The images may also be a list of files in any folders; `path` is then the folder of the first.
    """

    path: Path
    files: tuple[Path, ...]
    width: int
    height: int
    fps: float | None = None

    @classmethod
    def open(cls, path: str | Path) -> FolderReader:
        """Return the reader of a folder's images in the order of their numbers; the first is decoded.

        Raises:
            FileNotFoundError: the folder or the images are missing.
            ValueError: a number is missing or occurs twice, or the first image cannot be decoded.
        """
        path, files = Path(path), _images(Path(path))
        if gap := numbering_gap([f.stem for f in files]):
            raise ValueError(
                f"{path}: the images must be numbered without gaps, got {files[gap - 1].name} followed by "
                f"{files[gap].name}; extract the frames again, or go on without the missing ones (--gaps)."
            )
        return cls.of_files(files)

    @classmethod
    def of_files(cls, files: Sequence[Path], gaps: bool = False) -> FolderReader:
        """Return the reader of the images `files`; the first is decoded, with `gaps` the first that is readable.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: there are none, or the first cannot be decoded.
        """
        if not files:
            raise ValueError("FolderReader.of_files(): expected at least one image, got none; list the frames.")
        if not gaps and (missing := next((f for f in files if not f.is_file()), None)):
            raise _no_image(missing)
        readable = (f for f in files if not isinstance(_image_or_error(f), Exception)) if gaps else iter(files)
        first = _read_image(next(readable, files[0]))
        return cls(files[0].parent, tuple(files), first.shape[1], first.shape[0])

    @property
    def num_frames(self) -> int:
        """Number of images."""
        return len(self.files)

    @property
    def num_held(self) -> int:
        """Number of images."""
        return len(self.files)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1.

        Raises:
            ValueError: an image cannot be decoded or has another size than the first.
        """
        return _raising(self.pick(range(self.num_frames)[start:stop]))

    def pick(self, indices: Sequence[int]) -> Generator[ImageOrError, None, None]:
        """Yield the frames `indices`, with an error in place of each that is missing, broken or of another size."""
        for index in indices:
            if index >= self.num_frames:
                yield ValueError(f"{self.path}: it has ended after {self.num_frames} images; record longer.")
                continue
            frame = _image_or_error(self.files[index])
            if isinstance(frame, np.ndarray) and frame.shape[:2] != (self.height, self.width):
                frame = ValueError(
                    f"{self.files[index]}: expected {self.width}x{self.height} as in {self.files[0].name}, got "
                    f"{frame.shape[1]}x{frame.shape[0]}; extract the frames again."
                )
            yield frame


FrameReader = VideoReader | FolderReader
Clip = Path | tuple[Path, ...]
"""A video file, a folder of images, or a list of image files."""
ImageOrError = np.ndarray | ValueError | FileNotFoundError
"""A frame, or the reason why it is missing."""


def open_clips(clips: Sequence[Clip], gaps: bool = False) -> list[FrameReader]:
    """Return one reader per camera; with `gaps`, images may be missing or broken.

    Folders are then aligned by the numbers of their images, so that a number that only other cameras have is a missing
    image.

    Raises:
        FileNotFoundError: a clip is missing, or one of its images.
        ValueError: as `VideoReader.open` and `FolderReader.open`.
    """
    folders = [clip for clip in clips if isinstance(clip, Path) and clip.is_dir()]
    if not gaps or not folders:
        return [FolderReader.of_files(c, gaps) if isinstance(c, tuple) else open_frames(c) for c in clips]
    numbered = {folder: {_number(file): file for file in _images(folder)} for folder in folders}
    numbers = sorted(set().union(*numbered.values()))
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    instants = range(numbers[0], numbers[-1] + 1, step)
    return [
        FolderReader.of_files([numbered[clip].get(n, _missing_name(clip, numbered[clip], n)) for n in instants], gaps)
        if isinstance(clip, Path) and clip in numbered
        else open_clips([clip], gaps)[0]
        for clip in clips
    ]


def open_frames(path: str | Path | tuple[Path, ...]) -> FrameReader:
    """Return the reader of a video file, a folder of images or a list of images; raises the errors of their `open`."""
    if isinstance(path, tuple):
        return FolderReader.of_files(path)
    return FolderReader.open(path) if Path(path).is_dir() else VideoReader.open(path)


def _count_packets(path: Path) -> int:
    """Return the number of frames in a video file; they are read but not decoded, 0.2 ms each at 1080x1920."""
    stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    count = 0
    while stream.grab():
        count += 1
    stream.release()
    return count


def _raising(images: Iterator[ImageOrError]) -> Iterator[np.ndarray]:
    for image in images:
        if isinstance(image, Exception):
            raise image
        yield image


def _images(path: Path) -> list[Path]:
    """Return a folder's images in the order of their numbers."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a folder of images, found none; check the path.")
    found = (f for f in path.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES)
    files = sorted(found, key=lambda f: natural_key(f.stem))
    if not files:
        raise FileNotFoundError(
            f"{path}: expected images ({', '.join(IMAGE_SUFFIXES)}), found none; extract the frames."
        )
    return files


def _number(file: Path) -> int:
    numbers = re.findall(r"[0-9]+", file.stem)
    if not numbers:
        raise ValueError(f"{file}: expected an image whose name ends in a number, got none; extract the frames again.")
    return int(numbers[-1])


def _missing_name(folder: Path, files: dict[int, Path], number: int) -> Path:
    """Return the path that a missing image would have."""
    other = next(iter(files.values()))
    return folder / re.sub(r"[0-9]+(?=[^0-9]*\.)", lambda old: str(number).zfill(len(old[0])), other.name, count=1)


def _no_image(file: Path) -> FileNotFoundError:
    return FileNotFoundError(
        f"{file}: expected an image, found none; extract the frames again, or go on without it (--gaps)."
    )


def _image_or_error(file: Path) -> ImageOrError:
    try:
        return _read_image(file)
    except (ValueError, FileNotFoundError) as error:
        return error


def _read_image(file: Path) -> np.ndarray:
    if not file.is_file():
        raise _no_image(file)
    # The stored pixels, without EXIF's rotation: calibrations refer to those.
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ValueError(f"{file}: expected an image, got {file.stat().st_size} bytes that cannot be decoded.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
