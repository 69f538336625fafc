"""Frames in and out of video files and of folders of images.

A frame is an RGB uint8 array [H, W, 3]. `VideoReader` and `FolderReader` offer the same members.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.files import new_folder, whole

__all__ = [
    "Clip",
    "FolderReader",
    "FrameReader",
    "VideoReader",
    "natural_key",
    "numbering_gap",
    "open_frames",
    "write_video",
]

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that puts cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with int.
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", name))]


def numbering_gap(names: Sequence[str]) -> int | None:
    """Return the index of the first name whose last number does not continue the sequence, or None."""
    numbers = [int((re.findall(r"[0-9]+", name) or ["-1"])[-1]) for name in names]
    steps = np.diff(numbers)
    if len(names) < 2 or (min(numbers) >= 0 and steps.min() >= 1 and steps.min() == steps.max()):
        return None
    return 1 + int(np.argmax(steps != steps.min()) if steps.min() > 0 else np.argmin(steps))


@dataclass(frozen=True)
class VideoReader:
    """A video file, decoded from its start by each call of `frames`.

    Attributes:
        path: the file.
        num_frames: what the file's header promises.
        fps: frames per second.
        width: in pixels.
        height: in pixels.
        num_held: how many frames the file holds; less than `num_frames` where it was cut off.
    """

    path: Path
    num_frames: int
    fps: float | None
    width: int
    height: int
    num_held: int

    @classmethod
    def open(cls, path: str | Path) -> VideoReader:
        """Read a video's header, decode its first frame and count the others.

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
        # Some containers promise nothing.
        promised = num_frames if num_frames > 0 else held
        return cls(path, promised, fps if fps > 0 else None, first.shape[1], first.shape[0], held)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1; those before `start` are decoded too, for seeking is inexact.

        Raises:
            ValueError: a frame before `stop` (by default the promised end) cannot be decoded.
        """
        stop = self.num_frames if stop is None else min(stop, self.num_frames)
        stream = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        try:
            for index in range(stop):
                ok, frame = stream.read() if index >= start else (stream.grab(), None)
                if not ok:
                    raise ValueError(
                        f"{self.path}: frame {index} of {self.num_frames} cannot be decoded: the file is "
                        f"truncated or broken; copy it again or use the first {index} frames (max_frames)."
                    )
                if frame is not None:
                    yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        finally:
            stream.release()


@dataclass(frozen=True)
class FolderReader:
    """A folder of numbered images, e.g. ``0000.png``; members as in `VideoReader`, but no `fps`.

    It may also be a list of images that lie anywhere; `path` is then the folder of the first.
    """

    path: Path
    files: tuple[Path, ...]
    width: int
    height: int
    fps: float | None = None

    @classmethod
    def open(cls, path: str | Path) -> FolderReader:
        """List a folder's images in the order of their numbers and decode the first.

        Raises:
            FileNotFoundError: the folder or the images are missing.
            ValueError: a number is missing or given twice, or the first image cannot be decoded.
        """
        path = Path(path)
        if not path.is_dir():
            raise FileNotFoundError(f"{path}: expected a folder of images, found none; check the path.")
        files = sorted(
            (f for f in path.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES),
            key=lambda f: natural_key(f.stem),
        )
        if not files:
            raise FileNotFoundError(
                f"{path}: expected images ({', '.join(IMAGE_SUFFIXES)}), found none; extract the frames."
            )
        if gap := numbering_gap([f.stem for f in files]):
            raise ValueError(
                f"{path}: the images must be numbered without gaps, got {files[gap - 1].name} followed by "
                f"{files[gap].name}; extract the frames again."
            )
        return cls.of_files(files)

    @classmethod
    def of_files(cls, files: Sequence[Path]) -> FolderReader:
        """Take the images `files` in their order and decode the first.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: there are none, or the first cannot be decoded.
        """
        if not files:
            raise ValueError("FolderReader.of_files(): expected at least one image, got none; list the frames.")
        if missing := next((f for f in files if not f.is_file()), None):
            raise FileNotFoundError(f"{missing}: expected an image, found none; extract the frames again.")
        first = _read_image(files[0])
        return cls(files[0].parent, tuple(files), first.shape[1], first.shape[0])

    @property
    def num_frames(self) -> int:
        return len(self.files)

    @property
    def num_held(self) -> int:
        return len(self.files)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Yield frames start..stop-1.

        Raises:
            ValueError: an image cannot be decoded or has another size than the first.
        """
        for file in self.files[start:stop]:
            frame = _read_image(file)
            if frame.shape[:2] != (self.height, self.width):
                raise ValueError(
                    f"{file}: expected {self.width}x{self.height} as in {self.files[0].name}, got "
                    f"{frame.shape[1]}x{frame.shape[0]}; extract the frames again."
                )
            yield frame


FrameReader = VideoReader | FolderReader
# A video file, a folder of images, or images that lie anywhere.
Clip = Path | tuple[Path, ...]


def open_frames(path: str | Path | tuple[Path, ...]) -> FrameReader:
    """Open a video file, a folder of images or a list of images; raises what their `open` raises."""
    if isinstance(path, tuple):
        return FolderReader.of_files(path)
    return FolderReader.open(path) if Path(path).is_dir() else VideoReader.open(path)


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float, codec: str = "FFV1") -> None:
    """Write RGB uint8 frames [H, W, 3] as a video, or as a folder of PNGs where `path` has no suffix.

    The file gets its name only when all of it can be read back, so there is never a half-written one.

    Args:
        path: ``.mp4``, ``.mkv``, ``.avi``, ... or a folder that does not exist yet.
        frames: at least one, all of one even width and height (any size in a folder).
        fps: frames per second; a folder does not keep it.
        codec: OpenCV's four letters. ``FFV1`` is lossless, in .mp4 too, but no browser plays it. On a
            path-traced box at 304x224, 4:2:0 chroma alone allows 42.4 dB; ``vp09`` reaches 39.2 dB and plays
            in browsers at 37 ms a frame, ``mp4v`` 37.6 dB at 0.6 ms. ``avc1`` is not in OpenCV's wheels.

    Raises:
        ValueError: there are no frames, or a frame is not as described.
        OSError: the encoder is missing, the folder exists, or what was written cannot be read back.
    """
    path = Path(path)
    if path.suffix:
        with whole(path, "write_video()") as partial:
            partial.parent.mkdir(parents=True, exist_ok=True)
            _write_file(partial, path, frames, fps, codec)
        return
    with new_folder(path, "write_video()") as folder:
        for i, frame in enumerate(_checked(path, frames)):
            # Not cv2.imwrite, which says nothing of why it failed.
            png = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1]
            (folder / f"{i:04d}.png").write_bytes(png.tobytes())


def _write_file(partial: Path, path: Path, frames: Iterable[np.ndarray], fps: float, codec: str) -> None:
    count, encoder = 0, None
    try:
        for frame in _checked(path, frames):
            if encoder is None:
                height, width = frame.shape[:2]
                if width % 2 or height % 2:
                    raise ValueError(
                        f"write_video({path}): the width and height must be even, for OpenCV drops the last "
                        f"column or row otherwise, got {width}x{height}; crop, or write a folder of PNGs."
                    )
                fourcc = cv2.VideoWriter.fourcc(*codec)
                encoder = cv2.VideoWriter(str(partial), cv2.CAP_FFMPEG, fourcc, fps, (width, height))
                if not encoder.isOpened():
                    raise OSError(f"OpenCV could not open it with the encoder {codec!r}; try the codec FFV1 or mp4v")
            encoder.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        if encoder is not None:
            encoder.release()
    # OpenCV reports no failure of its writer, a full disk included: count what can be decoded.
    stream = cv2.VideoCapture(str(partial), cv2.CAP_FFMPEG)
    readable = 0
    while stream.grab():
        readable += 1
    stream.release()
    if readable != count:
        raise OSError(f"{count} frames were written but {readable} can be read back")


def _checked(path: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for i, frame in enumerate(frames):
        shape = frame.shape if shape is None else shape
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or frame.shape != shape:
            raise ValueError(
                f"write_video({path}): frame {i} must be uint8 [H, W, 3] of the first frame's size "
                f"{shape[:2]}, got {frame.dtype} {frame.shape}; convert it first."
            )
        yield frame
    if shape is None:
        raise ValueError(f"write_video({path}): at least one frame was expected, got none; pass frames.")


def _count_packets(path: Path) -> int:
    """Return how many frames a video file holds; they are read but not decoded, 0.2 ms each at 1080x1920."""
    stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    count = 0
    while stream.grab():
        count += 1
    stream.release()
    return count


def _read_image(file: Path) -> np.ndarray:
    # The stored pixels, not turned by EXIF: calibrations are made on those.
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ValueError(f"{file}: expected an image, got {file.stat().st_size} bytes that cannot be decoded.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
