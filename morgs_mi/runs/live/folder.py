"""Live images in a folder that another program fills, ``CAM/0000.png`` or ``CAM/0000.jpg``."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.listing import is_listed, listed
from morgs_mi.io.video import decode_image, image_number, natural_key
from morgs_mi.runs.live.feed import Bundle, Shot, bundled

__all__ = ["FolderFeed"]

_LOG = logging.getLogger(__name__)
_POLL = 0.05  # s
# Pause after which the numbers may begin again, s: images of several cameras are written in any order until then.
_PAUSE = 1.0
# Numbers per second that grow faster than this do not count images; they are times, or one is far ahead.
_MAX_RATE = 1000
# Suffixes of the images, whose last bytes show that the file is complete; what these bytes contain, and how many they
# are: cameras may add a few bytes behind an image.
_SUFFIXES = (".png", ".jpg", ".jpeg")
_ENDS, _TAIL = (b"IEND\xaeB`\x82", b"\xff\xd9"), 64

_Numbered = Mapping[int, Path]
_Found = Mapping[str, _Numbered]


class FolderFeed:
    """Live images in a folder that another program fills; it has the methods of `Feed`.

    Images with one number are of one time, and an image that is not complete yet is not read. Newer images have larger
    numbers. If none come, images that were written `_PAUSE` after the last bundle are newer, too: the program may count
    from 0 again, or one number was far ahead.

    Args:
        folder: with one folder of images per camera.
        timeout: seconds to wait for a camera before it is left out.
        names: names of the cameras; by default the names of the folders that have images when the second number begins.

    Raises:
        FileNotFoundError: there is no such folder.
    """

    def __init__(self, folder: Path, timeout: float, names: Sequence[str] | None = None) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected a folder with the images of the cameras, found none.")
        self.names = tuple(names or ())
        self._folder, self._timeout = folder, timeout
        # When the last bundle was written, and when the images began that are counted together with it, s of files.
        self._written = self._begin = 0.0

    def newest(self, after: Bundle | None = None) -> Bundle | None:
        """Wait for the newest bundle and return it; None if no camera delivers images any more."""
        start = time.monotonic()
        pause_end = start + _PAUSE
        while True:
            now = time.monotonic()
            late = now - start >= self._timeout
            paused = now >= pause_end or late
            for found in self._newer(after, paused):
                bundle = self._first(found, late) if after is None else self._next(found, after, late)
                if bundle is not None:
                    self._take(found, max(bundle.numbers), after)
                    return bundle
            if late:
                return self._end(after)
            pause_end = now + _PAUSE if paused else pause_end
            time.sleep(_POLL)

    def problem(self, camera: int) -> str:
        """Return why a camera has no image in the last bundle."""
        return f"no complete image in {self._folder / self.names[camera]} for {self._timeout:g} s"

    def ended(self) -> str:
        """Return why no camera delivers images any more."""
        return f"no complete new images in {self._folder} for {self._timeout:g} s"

    def close(self) -> None:
        """Do nothing: no file is open."""

    def _newer(self, after: Bundle | None, paused: bool) -> Iterator[_Found]:
        """Yield the images with larger numbers than a bundle; after a pause also all that were written since."""
        yield self._found(-1 if after is None else max(after.numbers), self._begin)
        if paused and after is not None:
            yield self._found(-1, self._written + _PAUSE)

    def _first(self, found: _Found, late: bool) -> Bundle | None:
        """Return the newest bundle of all cameras."""
        names = self.names or tuple(found)
        common = _common(found, names)
        if not self.names and not late:
            # Which cameras there are is known when the next number begins.
            common -= {max(number for files in found.values() for number in files)} if found else set()
        bundle = _bundle([found.get(name, {}) for name in names], common)
        if bundle is not None:
            if silent := [name for name in self._cameras() if name not in names and not self.names]:
                _LOG.warning("%s is left out: no image in %s", ", ".join(silent), self._folder)
            self.names = names
        return bundle

    def _next(self, found: _Found, after: Bundle, late: bool) -> Bundle | None:
        """Return the newest bundle of the cameras that are expected; if it is late, of those that have an image."""
        files = [found.get(name, {}) for name in self.names]
        numbers = [set(own) for own, image in zip(files, after.images, strict=True) if own or image is not None]
        if late:
            return _bundle(files, set.union(*numbers), after, partial=True)
        bundle = _bundle(files, set.intersection(*numbers), after)
        # A camera that has stopped during a fit has images that the others had, too, but long ago.
        newest = max((_arrival(own[max(own)]) for own in files if own), default=0.0)
        return bundle if bundle is not None and newest - bundle.time <= self._timeout else None

    def _take(self, found: _Found, number: int, after: Bundle | None) -> None:
        """Remember when the images of a number were written, and whether the count has begun again."""
        if after is not None and number <= (last := max(after.numbers)):
            if not self._begin:
                _LOG.warning("%s: the numbers go on with %d after %d", self._folder, number, last)
            self._begin = self._written + _PAUSE
        self._written = max(_written(files[number]) for files in found.values() if number in files)

    def _end(self, after: Bundle | None) -> None:
        """End the images.

        Raises:
            FileNotFoundError: the folder was removed.
            ValueError: there was no bundle.
        """
        if not self._folder.is_dir():
            raise FileNotFoundError(f"{self._folder}: expected the images of the cameras, but the folder was removed.")
        if after is None:
            raise ValueError(
                f"{self._folder}: expected images of {', '.join(self.names) or 'the cameras'} that have the same "
                f"number, such as CAM/0000.png, found folders called {', '.join(self._cameras()) or 'nothing'}"
                f"{self._lack()}; check the path and the names, or wait longer than {self._timeout:g} s (--timeout)."
            )

    def _lack(self) -> str:
        """Return a description of the images that are missing for a first bundle."""
        found = self._found(-1, 0.0)
        names = self.names or tuple(found)
        if silent := [name for name in names if name not in found]:
            return f", but no image of {', '.join(silent)}"
        if common := _common(found, names):
            broken = [name for name in names if _shot(found[name][max(common)], 0) is None]
            return f", but no complete image {max(common)} of {', '.join(broken)}"
        numbers = ", ".join(f"{min(own)} to {max(own)} of {name}" for name, own in found.items())
        return f", with {numbers}" if numbers else ""

    def _found(self, after: int, begin: float) -> dict[str, _Numbered]:
        """Return the images of each camera with numbers larger than `after` that were not written before `begin`."""
        found = {name: _images(self._folder / name, after, begin) for name in self.names or self._cameras()}
        return {name: files for name, files in found.items() if files}

    def _cameras(self) -> list[str]:
        """Return the names of the folders, in numerical order."""
        with suppress(FileNotFoundError):
            names = [file.name for file in listed(self._folder) if file.is_dir()]
            return sorted(names, key=natural_key)
        return []


def _common(found: _Found, names: Sequence[str]) -> set[int]:
    """Return the numbers that all cameras have."""
    return set.intersection(*(set(found.get(name, ())) for name in names)) if names else set()


def _bundle(
    files: Sequence[_Numbered], numbers: Collection[int], after: Bundle | None = None, partial: bool = False
) -> Bundle | None:
    """Return the bundle of the largest of `numbers` of which every file is complete; `partial`: or at least one."""
    for number in sorted(numbers, reverse=True):
        there = [own.get(number) for own in files]
        shots = [None if file is None else _shot(file, number) for file in there]
        complete = all(shot is not None or file is None for shot, file in zip(shots, there, strict=True))
        if complete or (partial and any(shots)):
            bundle = bundled(shots, [number] * len(shots), 0.0)
            return bundle if after is None else replace(bundle, dropped=_dropped(files, bundle, after))
    return None


def _dropped(files: Sequence[_Numbered], bundle: Bundle, after: Bundle) -> int:
    """Return the number of images that each camera delivered between two bundles."""
    number = max(bundle.numbers)
    between = number - max(after.numbers) - 1
    if 0 <= between <= _MAX_RATE * (1 + bundle.time - after.time):
        return between
    return min(
        sum(n < number for n in own) for own, image in zip(files, bundle.images, strict=True) if image is not None
    )


def _images(folder: Path, after: int, begin: float) -> dict[int, Path]:
    """Return the images in a folder, by their numbers, that are larger than `after`, not written before `begin`."""
    found = {}
    with suppress(FileNotFoundError, NotADirectoryError):
        for name in os.listdir(folder):
            if name.lower().endswith(_SUFFIXES) and is_listed(name):
                with suppress(ValueError):
                    found[image_number(Path(name))] = folder / name
    return {n: file for n, file in found.items() if n > after and (not begin or _written(file) >= begin)}


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
    return time.monotonic() - max(time.time() - _written(file), 0.0)


def _written(file: Path) -> float:
    """Return when a file was written, s since the epoch; now if it is not there any more."""
    with suppress(FileNotFoundError):
        return file.stat().st_mtime
    return time.time()
