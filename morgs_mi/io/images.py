"""Readers of folders of images, and of single image files.

A frame is an RGB array [H, W, 3]: uint8 in sRGB, or of an EXR file float32 in linear light.
`FolderReader` and `VideoReader` have the same members.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import cv2
import imagesize
import numpy as np

from morgs_mi.io.exr import read_light
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, by_stem, existing_file, images_in
from morgs_mi.io.numbering import check_counting, check_numbering, frames_by_number
from morgs_mi.platform.bounded import check_claim
from morgs_mi.platform.checks import errors_at
from morgs_mi.platform.png import has_whole_chunks

WHITE = 2**16 - 1
"""White of images of 16 bits, unless a capture sets another one."""
# Bytes of memory that a pixel takes, in BGR and RGB.
_BYTES_PER_PIXEL = 6
# What a file is expected to be, and the remedy if there is none.
_IMAGE = ("an image", "extract the frames again, or go on without it (--gaps)")

ImageOrError = np.ndarray | ValueError | FileNotFoundError
"""A frame, or the reason why it is missing."""


class Frames:
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
class FolderReader(Frames):
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
        step = check_numbering(path, images)
        numbers = range(min(images), max(images) + step, step)
        return replace(cls.of_files([*images.values()]), numbers=numbers)

    @classmethod
    def of_files(cls, files: Sequence[Path], gaps: bool = False) -> FolderReader:
        """Return the reader of the images `files`; the first is decoded, with `gaps` the first that
        is readable.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: the first cannot be decoded.
        """
        file = files[0]
        if gaps:
            file = next(filter(_is_readable, files), file)
        else:
            for each in files:
                existing_file(each, *_IMAGE)
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
            try:
                image = self._image(index)
            except (ValueError, FileNotFoundError) as error:
                image = error
            yield image

    def _image(self, index: int) -> np.ndarray:
        """Return a frame.

        Raises:
            FileNotFoundError: it is missing.
            ValueError: it is broken, of another size, or behind the last one.
        """
        if index >= self.num_frames:
            raise ValueError(
                f"{self.path}: it has ended after {self.num_frames} images; record longer."
            )
        file = self.files[index]
        image = _read_image(file)
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"{file}: expected {self.width}x{self.height} as in {self.files[0].name}, got "
                f"{image.shape[1]}x{image.shape[0]}; extract the frames again."
            )
        with errors_at(file):
            return eight_bits(image, self.white)


def aligned_folders(folders: Mapping[str, Path]) -> dict[str, FolderReader]:
    """Return the readers of cameras' folders of images, aligned by the numbers of their images.

    Raises:
        ValueError: the numbers of a folder do not count, those of two do not overlap, or there are
            far more timestamps than images.
    """
    if not folders:
        return {}
    clips = {name: _images(folder) for name, folder in folders.items()}
    for name, files in clips.items():
        check_counting(folders[name], files)
    first = max(map(min, clips.values()))
    last = min(map(max, clips.values()))
    if first > last:
        raise ValueError(
            f"{next(iter(folders.values())).parent}: expected cameras with numbers of images that "
            f"overlap, got one that ends with {last} and one that begins with {first}; pair their "
            "images by position with --offset in place of --gaps, or leave one out with --exclude."
        )
    numbers = sorted(set().union(*clips.values()))
    steps = np.diff(numbers)
    step = math.gcd(*steps.tolist()) or 1
    if (numbers[-1] - numbers[0]) // step > 10 * len(numbers) + 1000:
        gap = int(np.argmax(steps))
        place = next(iter(folders.values())).parent
        raise ValueError(
            f"{place}: expected numbers of images without large gaps, got {numbers[gap + 1]} after "
            f"{numbers[gap]}; remove or renumber the image."
        )
    timestamps = range(numbers[0], numbers[-1] + 1, step)
    readers: dict[str, FolderReader] = {}
    for name, files in clips.items():
        suffix = next(iter(files.values())).suffix
        images = [files.get(n, folders[name] / f"{n:04d}{suffix}") for n in timestamps]
        readers[name] = replace(FolderReader.of_files(images, gaps=True), numbers=timestamps)
    return readers


def _images(path: Path) -> dict[int, Path]:
    """Return a folder's images by their numbers, in natural order."""
    images = by_stem(images_in(path) if path.is_dir() else [])
    if not images:
        suffixes = ", ".join((*IMAGE_SUFFIXES, EXR_SUFFIX))
        raise FileNotFoundError(f"{path}: expected images ({suffixes}), found none; extract them.")
    return frames_by_number(path, images)


def _is_readable(file: Path) -> bool:
    try:
        _read_image(file)
    except (ValueError, FileNotFoundError):
        return False
    return True


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


def eight_bits(image: np.ndarray, white: int) -> np.ndarray:
    """Return an image of 16 bits with 8 bits, any other one as it is.

    Raises:
        ValueError: a value is above white.
    """
    if image.dtype != np.uint16:
        return image
    if image.max() > white:
        raise ValueError(
            f"expected values up to the `white` of capture.json, {white}, got {image.max()}; "
            "correct it."
        )
    return cv2.convertScaleAbs(image, alpha=255 / white)
