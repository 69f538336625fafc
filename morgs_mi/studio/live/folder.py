"""Live images in a folder that another program fills, ``CAM/0000.png`` or ``CAM/0000.jpg``."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.listing import is_listed, listed
from morgs_mi.io.video import decode_image, image_number, natural_key
from morgs_mi.studio.live.feed import Bundle, Shot, bundled

_LOG = logging.getLogger(__name__)
_POLL = 0.05  # s
# Pause after which the numbers may begin again, s: images of several cameras are written in any
# order until then.
PAUSE = 1.0
# Numbers per second that grow faster than this do not count images; they are times, or one is far
# ahead.
_MAX_RATE = 1000
# Suffixes of the images, whose last bytes show that the file is complete; what these bytes contain,
# and how many they are: cameras may add a few bytes behind an image.
_SUFFIXES = (".png", ".jpg", ".jpeg")
_ENDS = (b"IEND\xaeB`\x82", b"\xff\xd9")
_TAIL = 64


@dataclass(frozen=True)
class _Images:
    """Images of a camera."""

    files: Mapping[int, Path]  # by number
    # time by which `time.monotonic` is ahead of the times of the files, s: the program that writes
    # them may run on a machine with another clock
    lead: float = 0.0

    def arrival(self, number: int) -> float:
        """Return when an image was written, s of `time.monotonic`."""
        return _written(self.files[number]) + self.lead

    def since(self, begin: float) -> _Images:
        """Return the images that did not arrive before `begin`, s of `time.monotonic`."""
        return replace(
            self, files={n: file for n, file in self.files.items() if self.arrival(n) >= begin}
        )


_Found = Mapping[str, _Images]
_NONE = _Images({})


class FolderFeed:
    """Live images in a folder that another program fills; it has the methods of `Feed`.

    Images with one number are of one time, and an image that is not complete yet is not read. Newer
    images have larger numbers. If none come, images that were written `PAUSE` after the last bundle
    are newer, too: the program may count from 0 again, or one number was far ahead.

    Args:
        folder: with one folder of images per camera.
        timeout: seconds to wait for a camera before it is left out.
        names: names of the cameras; by default the names of the folders that have images when the
            second number begins.

    Raises:
        FileNotFoundError: there is no such folder.
    """

    def __init__(self, folder: Path, timeout: float, names: Sequence[str] | None = None) -> None:
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{folder}: expected a folder with the images of the cameras, found none."
            )
        self.names = tuple(names or ())
        self._folder = folder
        self._timeout = timeout
        # By camera, see `_Images.ahead`.
        self._leads: dict[str, float] = {}
        # When the last bundle was returned, s of `time.monotonic`.
        self._return_time = time.monotonic()
        # By camera, when the images of the last bundle were written, and those before the ones that
        # are counted together with it, s of their files.
        self._write_times: dict[str, float] = {}
        self._old_write_times: dict[str, float] = {}

    def newest(self, after: Bundle | None = None) -> Bundle | None:
        """Wait for the newest bundle and return it; None if no camera delivers images any more."""
        start = time.monotonic()
        pause_end = start + PAUSE
        search_time = self._return_time
        while True:
            current_time = time.monotonic()
            late = current_time - start >= self._timeout
            has_paused = current_time >= pause_end or late
            for images in self._newer(after, has_paused):
                bundle = (
                    self._first(images, late) if after is None else self._next(images, after, late)
                )
                if bundle is not None:
                    self._take(images, max(bundle.numbers), after)
                    # Images that are not waited for may have been there for longer.
                    return self._arrived(bundle, self._return_time if has_paused else search_time)
            if late:
                return self._end(after)
            pause_end = current_time + PAUSE if has_paused else pause_end
            search_time = current_time
            time.sleep(_POLL)

    def problem(self, camera: int) -> str:
        """Return why a camera has no image in the last bundle."""
        return f"no complete image in {self._folder / self.names[camera]} for {self._timeout:g} s"

    def ended(self) -> str:
        """Return why no camera delivers images any more."""
        return f"no complete new images in {self._folder} for {self._timeout:g} s"

    def close(self) -> None:
        """Do nothing: no file is open."""

    def _newer(self, bundle: Bundle | None, has_paused: bool) -> Iterator[_Found]:
        """Yield the images with larger numbers than a bundle; after a pause also all that were
        written since.
        """
        yield self._found(-1 if bundle is None else max(bundle.numbers), self._old_write_times)
        if has_paused and bundle is not None:
            yield self._found(-1, self._write_times)

    def _first(self, by_name: _Found, late: bool) -> Bundle | None:
        """Return the newest bundle of all cameras."""
        names = self.names or tuple(by_name)
        common = _common(by_name, names)
        if not self.names and not late and by_name:
            # Which cameras there are is known when the next number begins.
            common -= {max(number for images in by_name.values() for number in images.files)}
        bundle = _bundle([by_name.get(name, _NONE) for name in names], common)
        if bundle is None:
            return None
        if not self.names:
            if not late and set(self._found(-1, self._old_write_times)) - set(names):
                # The first image of a camera came while the folders were read.
                return None
            self._warn_of_silent(names)
            self.names = names
        return bundle

    def _warn_of_silent(self, names: Sequence[str]) -> None:
        """Log the folders of cameras that are not among `names`."""
        if silent := [name for name in self._cameras() if name not in names]:
            _LOG.warning("%s is left out: no image in %s", ", ".join(silent), self._folder)

    def _next(self, by_name: _Found, last_bundle: Bundle, late: bool) -> Bundle | None:
        """Return the newest bundle of the cameras that are expected; if it is late, of those that
        have an image.
        """
        cameras = [by_name.get(name, _NONE) for name in self.names]
        pairs = zip(cameras, last_bundle.images, strict=True)
        numbers = [
            set(camera.files) for camera, image in pairs if camera.files or image is not None
        ]
        if late:
            return _bundle(cameras, set.union(*numbers), last_bundle, partial=True)
        bundle = _bundle(cameras, set.intersection(*numbers), last_bundle)
        # A camera that has stopped during a fit has images that the others had, too, but long ago.
        is_current = bundle is not None and _newest(cameras) - bundle.time <= self._timeout
        return bundle if is_current else None

    def _take(self, by_name: _Found, number: int, last_bundle: Bundle | None) -> None:
        """Store when the images of a number were written, and whether the count has begun again."""
        if last_bundle is not None and number <= max(last_bundle.numbers):
            self._begin_count(number, max(last_bundle.numbers))
        images = {
            name: images.files[number] for name, images in by_name.items() if number in images.files
        }
        self._write_times = {name: _written(file) for name, file in images.items()}

    def _begin_count(self, number: int, last: int) -> None:
        """Store that the images are counted again from `number`, after `last`."""
        if not self._old_write_times:
            _LOG.warning("%s: the numbers go on with %d after %d", self._folder, number, last)
        self._old_write_times = self._write_times

    def _arrived(self, bundle: Bundle, begin: float) -> Bundle:
        """Return a bundle that was not there at the time `begin`, by whatever clock."""
        self._return_time = time.monotonic()
        return replace(bundle, time=min(max(bundle.time, begin), self._return_time))

    def _end(self, last_bundle: Bundle | None) -> None:
        """End the images.

        Raises:
            FileNotFoundError: the folder was removed.
            ValueError: there was no bundle.
        """
        if not self._folder.is_dir():
            raise FileNotFoundError(
                f"{self._folder}: expected the images of the cameras, but the folder was removed."
            )
        if last_bundle is None:
            raise ValueError(
                f"{self._folder}: expected images of {', '.join(self.names) or 'the cameras'} "
                "that have the same number, such as CAM/0000.png, found folders called "
                f"{', '.join(self._cameras()) or 'nothing'}{self._lack()}; check the path and the "
                f"names, or wait longer than {self._timeout:g} s (--timeout)."
            )

    def _lack(self) -> str:
        """Return a description of the images that are missing for a first bundle."""
        by_name = self._found(-1, {})
        names = self.names or tuple(by_name)
        if silent := [name for name in names if name not in by_name]:
            return f", but no image of {', '.join(silent)}"
        if common := _common(by_name, names):
            incomplete = [name for name in names if _shot(by_name[name], max(common)) is None]
            return f", but no complete image {max(common)} of {', '.join(incomplete)}"
        return f", with {_listed_numbers(by_name)}" if by_name else ""

    def _found(self, limit: int, write_times: Mapping[str, float]) -> dict[str, _Images]:
        """Return the images of each camera with numbers larger than `limit`, without images of the
        time of others.

        Args:
            limit: number.
            write_times: by camera, when an image was written, s of the file; images written up to
                `PAUSE` later are of the same time. Empty: no image is left out.
        """
        by_name = self._images(limit)
        if not write_times:
            return by_name
        begin = self._end_of_pause(write_times)
        by_name = {name: images.since(begin) for name, images in by_name.items()}
        return {name: images for name, images in by_name.items() if images.files}

    def _end_of_pause(self, write_times: Mapping[str, float]) -> float:
        """Return when images are of another time than those written at `write_times`, s of
        `time.monotonic`.
        """
        return PAUSE + max(
            write_time + self._leads.get(name, 0.0) for name, write_time in write_times.items()
        )

    def _images(self, limit: int) -> dict[str, _Images]:
        """Return the images of each camera with numbers larger than `limit`."""
        by_name = {}
        for name in self.names or self._cameras():
            if files := files_of_camera(self._folder / name, limit):
                self._compare_clocks(name, files[max(files)])
                by_name[name] = _Images(files, self._leads.get(name, 0.0))
        return by_name

    def _compare_clocks(self, name: str, file: Path) -> None:
        """Compare the clock of a camera's files with this machine's by one of its images.

        An image is found after it was written, so the smallest difference is the most accurate one.
        """
        with suppress(FileNotFoundError):
            lead = time.monotonic() - file.stat().st_mtime
            self._leads[name] = min(lead, self._leads.get(name, inf))

    def _cameras(self) -> list[str]:
        """Return the names of the folders, in numerical order."""
        with suppress(FileNotFoundError):
            names = [file.name for file in listed(self._folder) if file.is_dir()]
            return sorted(names, key=natural_key)
        return []


def _listed_numbers(by_name: _Found) -> str:
    """Return the first and last numbers of each camera as text."""
    return ", ".join(
        f"{min(images.files)} to {max(images.files)} of {name}" for name, images in by_name.items()
    )


def _common(by_name: _Found, names: Sequence[str]) -> set[int]:
    """Return the numbers that all cameras have."""
    return (
        set.intersection(*(set(by_name.get(name, _NONE).files) for name in names))
        if names
        else set()
    )


def _newest(cameras: Sequence[_Images]) -> float:
    """Return when the last of the newest images of all cameras arrived, s of `time.monotonic`."""
    return max(
        (camera.arrival(max(camera.files)) for camera in cameras if camera.files), default=0.0
    )


def _bundle(
    cameras: Sequence[_Images],
    numbers: Collection[int],
    last_bundle: Bundle | None = None,
    partial: bool = False,
) -> Bundle | None:
    """Return the bundle of the largest of `numbers` of which every file is complete; `partial`: or
    at least one.
    """
    for number in sorted(numbers, reverse=True):
        shots = [_shot(images, number) for images in cameras]
        complete = all(
            shot or number not in images.files for shot, images in zip(shots, cameras, strict=True)
        )
        if complete or (partial and any(shots)):
            bundle = bundled(shots, [number] * len(shots), 0.0)
            dropped = _dropped(cameras, bundle, last_bundle) if last_bundle else 0
            return replace(bundle, dropped=dropped)
    return None


def _dropped(cameras: Sequence[_Images], bundle: Bundle, last_bundle: Bundle) -> int:
    """Return the number of images that each camera delivered between two bundles."""
    number = max(bundle.numbers)
    count = number - max(last_bundle.numbers) - 1
    if 0 <= count <= _MAX_RATE * (1 + bundle.time - last_bundle.time):
        return count
    pairs = zip(cameras, bundle.images, strict=True)
    return min(
        sum(n < number for n in images.files) for images, image in pairs if image is not None
    )


def files_of_camera(folder: Path, limit: int) -> dict[int, Path]:
    """Return the image files of a camera's folder by number, of numbers above `limit`."""
    files = {}
    for name in _image_names(folder):
        with suppress(ValueError):
            files[image_number(Path(name))] = folder / name
    return {number: file for number, file in files.items() if number > limit}


def _image_names(folder: Path) -> list[str]:
    """Return the names of the images in a folder, none if it does not exist."""
    with suppress(FileNotFoundError, NotADirectoryError):
        names = os.listdir(folder)
        return [name for name in names if name.lower().endswith(_SUFFIXES) and is_listed(name)]
    return []


def _shot(images: _Images, number: int) -> Shot | None:
    """Return an image, None if it is not complete yet or not there any more."""
    if number not in images.files:
        return None
    file = images.files[number]
    try:
        data = np.fromfile(file, np.uint8)
        arrival = images.arrival(number)
        if not any(end in data[-_TAIL:].tobytes() for end in _ENDS):
            return None
        image = decode_image(file, data, cv2.IMREAD_COLOR)
    except (ValueError, FileNotFoundError):
        return None
    return Shot(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), arrival, number)


def _written(file: Path) -> float:
    """Return when a file was written, s since the epoch; now if it is not there any more."""
    with suppress(FileNotFoundError):
        return file.stat().st_mtime
    return time.time()
