"""Live images of cameras, streams and pipes: a thread for each of them reads all images and stores the newest."""

from __future__ import annotations

import atexit
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from threading import Condition, Event, Thread

import numpy as np

from morgs_mi.studio.live.feed import Bundle, Shot, bundled

# Images of a camera from which the one that agrees best with the others is chosen: networks deliver them in bursts.
_KEPT = 4
# Largest skew of a bundle, s: the skew of unsynchronised cameras with one image per second.
_MAX_SKEW = 0.5
_CLOSING = 12.0  # longest wait for the threads, s; a connection or a driver may take 10 s to fail


class CameraFeed:
    """Live images of cameras that are read side by side; it has the methods of `Feed`.

    Images are bundled by the times of their arrival: the newest one of the slowest camera, and of each other camera the
    one that is nearest in time.

    Args:
        cameras: the images of each camera, uint8 [H, W, 3], RGB, by its name, with None where one is missing. Their
            iterators wait for the next image.
        timeout: seconds to wait for a camera before it is left out.
        warm_up: seconds that the cameras have, after the first image of the last of them, to adjust their exposure.
        closed: is set when the feed is closed; an iterator that waits ends then.
        ended: why there are no images any more of a camera that ends without an error.
    """

    def __init__(
        self,
        cameras: Mapping[str, Iterable[np.ndarray | None]],
        timeout: float,
        warm_up: float = 0.0,
        closed: Event | None = None,
        ended: str = "it has ended",
    ) -> None:
        self.names = tuple(cameras)
        self._timeout = timeout
        self._warm_up = warm_up
        self._changed = Condition()
        self._closed = closed or Event()
        self._cameras = [_Camera(images, self._changed, self._closed, ended) for images in cameras.values()]
        # A thread that executes library code when the interpreter ends aborts the process.
        atexit.register(self.close)
        for camera in self._cameras:
            camera.start()

    def newest(self, after: Bundle | None = None) -> Bundle | None:
        """Wait for the newest bundle and return it; None if no camera delivers images any more."""
        with self._changed:
            if after is None:
                self._wait_for_first()
            deadline = time.monotonic() + self._timeout
            while True:
                left = deadline - time.monotonic()
                running = any(camera.ended is None for camera in self._cameras)
                new = [camera.newer(after.numbers[k] if after else -1) for k, camera in enumerate(self._cameras)]
                if after is not None and running:
                    expected = self._expected(new, after, late=left <= 0)
                else:  # the first images have to be complete, and so have the last ones
                    expected = [after is None or after.images[k] is not None for k in range(len(new))]
                if shots := _nearest(new, expected):
                    times = [shot.time for shot in shots if shot is not None]
                    numbers = [camera.shots[-1].number for camera in self._cameras]
                    return bundled(shots, numbers, max(times) - min(times), _dropped(shots, after))
                if running and left > 0:
                    self._changed.wait(left)
                elif after is not None:
                    return None
                else:
                    raise ValueError(
                        f"CameraFeed(): expected simultaneous images of {', '.join(self.names)}, got none that arrived "
                        f"within {_MAX_SKEW:g} s of each other; start the cameras together."
                    )

    def problem(self, camera: int) -> str:
        """Return why a camera has no image in the last bundle."""
        return self._cameras[camera].ended or f"no image for {self._timeout:g} s"

    def ended(self) -> str:
        """Return why no camera delivers images any more."""
        names: dict[str, list[str]] = {}
        for k, name in enumerate(self.names):
            names.setdefault(self.problem(k), []).append(name)
        return "; ".join(f"{', '.join(those)}: {problem}" for problem, those in names.items())

    def close(self) -> None:
        """End the reading."""
        atexit.unregister(self.close)
        self._closed.set()
        deadline = time.monotonic() + _CLOSING
        for camera in self._cameras:
            camera.join(max(0.0, deadline - time.monotonic()))

    def _expected(self, new: Sequence[Sequence[Shot]], after: Bundle, late: bool) -> list[bool]:
        """Return for each camera whether the bundle has to have its image.

        A camera that runs is waited for, unless it is late or was missing before; an image of another has to be of the
        time of the newest.
        """
        waited = [not late and camera.ended is None for camera in self._cameras]
        return [
            image is not None or bool(shots) if wait else recent
            for wait, image, shots, recent in zip(waited, after.images, new, _simultaneous(new), strict=True)
        ]

    def _wait_for_first(self) -> None:
        """Wait until every camera has had an image, and has adjusted its exposure.

        Raises:
            OSError, ValueError: one has none.
        """
        deadline = time.monotonic() + self._timeout
        while silent := [k for k, camera in enumerate(self._cameras) if not camera.shots]:
            left = deadline - time.monotonic()
            for name, camera in ((self.names[k], self._cameras[k]) for k in silent):
                if camera.error is not None:
                    raise camera.error
                if camera.ended is not None or left <= 0:
                    raise ValueError(
                        f"CameraFeed(): expected images of {name}, got none ({camera.ended or 'it is silent'}); check "
                        f"that it records, or wait for it longer than {self._timeout:g} s (--timeout)."
                    )
            self._changed.wait(left)
        end = time.monotonic() + self._warm_up
        while (left := end - time.monotonic()) > 0 and all(camera.ended is None for camera in self._cameras):
            self._changed.wait(left)


class _Camera(Thread):
    """Thread that reads the images of a camera; its state is guarded by `changed`."""

    def __init__(self, images: Iterable[np.ndarray | None], changed: Condition, closed: Event, ended: str) -> None:
        super().__init__(daemon=True, name="camera")
        self.shots: deque[Shot] = deque(maxlen=_KEPT)
        self.ended: str | None = None  # why there are no images any more
        self.error: Exception | None = None
        self._images = images
        self._changed = changed
        self._closed = closed
        self._ended = ended

    def run(self) -> None:
        """Read until the source ends or the feed is closed."""
        number = 0
        try:
            for image in self._images:
                if image is not None:
                    with self._changed:
                        self.shots.append(Shot(image, time.monotonic(), number))
                        self._changed.notify_all()
                    number += 1
                if self._closed.is_set():
                    break
        except Exception as error:
            self.error = error
        finally:
            if (close := getattr(self._images, "close", None)) is not None:
                close()
            with self._changed:
                self.ended = str(self.error or self._ended)
                self._changed.notify_all()

    def newer(self, number: int) -> list[Shot]:
        """Return the stored shots after the one with a number."""
        return [shot for shot in self.shots if shot.number > number]


def _simultaneous(new: Sequence[Sequence[Shot]]) -> list[bool]:
    """Return for each camera whether its newest shot may be in a bundle with the newest of all."""
    last = max((shots[-1].time for shots in new if shots), default=0.0)
    return [bool(shots) and last - shots[-1].time <= _MAX_SKEW for shots in new]


def _nearest(new: Sequence[Sequence[Shot]], expected: Sequence[bool]) -> list[Shot | None] | None:
    """Return a shot of each expected camera, all within `_MAX_SKEW`; None if one has none yet, or none is expected."""
    groups = [shots for shots, wanted in zip(new, expected, strict=True) if wanted]
    if not groups or not all(groups):
        return None
    time_of_slowest = min(shots[-1].time for shots in groups)
    chosen = [
        min(shots, key=lambda shot: abs(shot.time - time_of_slowest)) if wanted else None
        for shots, wanted in zip(new, expected, strict=True)
    ]
    times = [shot.time for shot in chosen if shot is not None]
    return chosen if max(times) - min(times) <= _MAX_SKEW else None


def _dropped(shots: Sequence[Shot | None], after: Bundle | None) -> int:
    """Return the number of images that each camera delivered between two bundles."""
    if after is None:
        return 0
    return min(shot.number - last - 1 for shot, last in zip(shots, after.numbers, strict=True) if shot is not None)
