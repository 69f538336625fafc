"""Live images in a folder that another program fills, ``CAM/0000.png`` or ``CAM/0000.jpg``."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.video import IMAGE_SUFFIXES, decode_image, image_number, natural_key
from morgs_mi.live.feed import Bundle, Shot, bundled

__all__ = ["FolderFeed"]

_POLL = 0.05  # s
# What the last bytes of a complete file contain, and how many of them; cameras may add a few bytes behind an image.
_ENDS, _TAIL = (b"IEND\xaeB`\x82", b"\xff\xd9"), 64

_Numbered = Mapping[int, Path]


class FolderFeed:
    """Live images in a folder that another program fills; its methods are those of `Feed`.

    Images with one number are of one time. An image that is not complete yet is not read.

    Args:
        folder: with one folder of images per camera.
        timeout: seconds to wait for a camera before it is left out.
        names: names of the cameras; by default those of the folders that have images when the second number begins.

    Raises:
        FileNotFoundError: there is no such folder.
    """

    def __init__(self, folder: Path, timeout: float, names: Sequence[str] | None = None) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected a folder with the images of the cameras, found none.")
        self.names = tuple(names or ())
        self._folder, self._timeout = folder, timeout

    def newest(self, after: Bundle | None = None) -> Bundle | None:
        """Wait for the newest bundle and return it; None if no camera delivers images any more."""
        deadline = time.monotonic() + self._timeout
        while True:
            late = time.monotonic() >= deadline
            found = self._newer(max(after.numbers) if after else -1)
            bundle = self._first(found) if after is None else self._next(found, after, late)
            if bundle is not None:
                return bundle
            if late and after is None:
                cameras, found = ", ".join(self.names) or "the cameras", ", ".join(self._cameras()) or "nothing"
                raise ValueError(
                    f"{self._folder}: expected images of {cameras} that have the same number, such as CAM/0000.png, "
                    f"found folders called {found}; check the path and the names, or wait longer than "
                    f"{self._timeout:g} s (--timeout)."
                )
            if late:
                return None
            time.sleep(_POLL)

    def problem(self, camera: int) -> str:
        """Return why a camera has no image in the last bundle."""
        return f"no complete image in {self._folder / self.names[camera]} for {self._timeout:g} s"

    def close(self) -> None:
        """Do nothing: no file is open."""

    def _first(self, found: Mapping[str, _Numbered]) -> Bundle | None:
        """Return the newest bundle of all cameras."""
        names = self.names or tuple(found)
        common = set.intersection(*(set(found.get(name, ())) for name in names)) if names else set()
        if not self.names:
            # Which cameras there are is known when the next number begins.
            common -= {max(number for files in found.values() for number in files)} if found else set()
        bundle = _bundle([found.get(name, {}) for name in names], common)
        if bundle is not None:
            self.names = names
        return bundle

    def _next(self, found: Mapping[str, _Numbered], after: Bundle, late: bool) -> Bundle | None:
        """Return the newest bundle of the cameras that are expected; if it is late, of those that have an image."""
        files = [found.get(name, {}) for name in self.names]
        numbers = [set(own) for own, image in zip(files, after.images, strict=True) if own or image is not None]
        if late:
            return _bundle(files, set.union(*numbers), after, partial=True)
        bundle = _bundle(files, set.intersection(*numbers), after)
        # A camera that has stopped during a fit has images that the others had, too, but long ago.
        newest = max((_arrival(own[max(own)]) for own in files if own), default=0.0)
        return bundle if bundle is not None and newest - bundle.time <= self._timeout else None

    def _newer(self, number: int) -> dict[str, _Numbered]:
        """Return the images with larger numbers of each camera that has some."""
        found = {name: _images(self._folder / name, number) for name in self.names or self._cameras()}
        return {name: files for name, files in found.items() if files}

    def _cameras(self) -> list[str]:
        """Return the names of the folders, in numerical order."""
        names = [file.name for file in self._folder.iterdir() if file.is_dir() and not file.name.startswith(".")]
        return sorted(names, key=natural_key)


def _bundle(
    files: Sequence[_Numbered], numbers: set[int], after: Bundle | None = None, partial: bool = False
) -> Bundle | None:
    """Return the bundle of the largest of `numbers` of which every file is complete; `partial`: or at least one."""
    for number in sorted(numbers, reverse=True):
        there = [own.get(number) for own in files]
        shots = [None if file is None else _shot(file, number) for file in there]
        complete = all(shot is not None or file is None for shot, file in zip(shots, there, strict=True))
        if complete or (partial and any(shots)):
            return bundled(shots, [number] * len(shots), 0.0, after)
    return None


def _images(folder: Path, after: int) -> dict[int, Path]:
    """Return the images in a folder with a number larger than `after`, by their numbers."""
    found = {}
    with suppress(FileNotFoundError, NotADirectoryError):
        for name in os.listdir(folder):
            if name.lower().endswith(IMAGE_SUFFIXES) and not name.startswith("."):
                with suppress(ValueError):
                    found[image_number(Path(name))] = folder / name
    return {number: file for number, file in found.items() if number > after}


def _shot(file: Path, number: int) -> Shot | None:
    """Return the image in a file, None if it is not complete yet or not there any more."""
    try:
        data, arrival = np.fromfile(file, np.uint8), _arrival(file)
        if not any(end in data[-_TAIL:].tobytes() for end in _ENDS):
            return None
        image = decode_image(file, data, cv2.IMREAD_COLOR)
    except (ValueError, FileNotFoundError):
        return None
    return Shot(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), arrival, number)


def _arrival(file: Path) -> float:
    """Return when a file was written, s of `time.monotonic`; now if it is not there any more."""
    with suppress(FileNotFoundError):
        return time.monotonic() - max(time.time() - file.stat().st_mtime, 0.0)
    return time.monotonic()
