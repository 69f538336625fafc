"""Live images of cameras and streams: a thread for each of them reads all images and stores the
newest.
"""

from __future__ import annotations

import atexit
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from threading import Condition, Event, Thread

import numpy as np

from morgs_mi.io.prefetch import close_items
from morgs_mi.platform.checks import require

# Images of a camera from which the one that agrees best with the others is chosen: networks deliver
# them in bursts.
_KEPT = 4
# Largest skew of a frame set, s: the skew of unsynchronised cameras with one image per second.
_MAX_SKEW = 0.5
_CLOSING = 12.0  # longest wait for the threads, s; a connection or a driver may take 10 s to fail


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of one camera."""

    image: np.ndarray  #: uint8 [H, W, 3], RGB.
    time: float  #: At which it arrived, s of `time.monotonic`.
    number: int  #: Its number among the camera's images, without gaps.


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Images of the cameras at about one time."""

    images: Mapping[str, np.ndarray]  #: Of each camera that has one, uint8 [H, W, 3], RGB.
    #: Per camera the number of its image, or of its newest one before where it has none.
    numbers: Mapping[str, int]
    time: float  #: At which the last of the images arrived, s of `time.monotonic`.
    skew: float  #: Largest difference in time between two of the images, s.
    #: Number of images that each camera delivered after the frame set before and that are in none.
    dropped: int


class CameraFeed:
    """Live images of cameras that are read side by side.

    A frame set has the newest image of the slowest camera, and of each other camera the image with
    the nearest time of arrival.

    Args:
        cameras: the images of each camera, uint8 [H, W, 3], RGB, by its name, with None where one
            is missing. Their iterators wait for the next image.
        timeout: seconds to wait for a camera before it is left out.
        warm_up: seconds that the cameras have, after the first image of the last of them, to adjust
            their exposure.
        closed: is set when the feed is closed; an iterator that waits ends then.
    """

    def __init__(
        self,
        cameras: Mapping[str, Iterable[np.ndarray | None]],
        timeout: float,
        warm_up: float = 0.0,
        closed: Event | None = None,
    ) -> None:
        self._timeout = timeout
        self._warm_up = warm_up
        self._change = Condition()
        self._stop_event = closed or Event()
        self._cameras = {
            name: _Camera(images, self._change, self._stop_event)
            for name, images in cameras.items()
        }
        # A thread that executes library code when the interpreter ends aborts the process.
        atexit.register(self.close)
        for camera in self._cameras.values():
            camera.start()

    def newest(self, after: FrameSet | None = None) -> FrameSet | None:
        """Wait for the newest frame set and return it; None if no camera delivers images any more.

        The first frame set has an image of every camera.

        Args:
            after: the frame set before; all images of the new one are newer.

        Raises:
            OSError, ValueError: a camera cannot be opened, or has no first image.
        """
        with self._change:
            if after is None:
                self._wait_for_first()
            deadline = time.monotonic() + self._timeout
            while True:
                time_left = deadline - time.monotonic()
                is_running = any(camera.reason is None for camera in self._cameras.values())
                frame_set = self._frame_set(after, is_running, late=time_left <= 0)
                if frame_set is not None:
                    return frame_set
                if is_running and time_left > 0:
                    self._change.wait(time_left)
                else:
                    require(
                        after,
                        "CameraFeed()",
                        f"expected simultaneous images of {', '.join(self._cameras)}",
                        f"none that arrived within {_MAX_SKEW:g} s of each other",
                        "start the cameras together",
                    )
                    return None

    def problem(self, camera: str) -> str:
        """Return why a camera has no image in the last frame set, by its name."""
        return self._cameras[camera].reason or f"no image for {self._timeout:g} s"

    def ended(self) -> str:
        """Return why no camera delivers images any more."""
        names: dict[str, list[str]] = {}
        for name in self._cameras:
            names.setdefault(self.problem(name), []).append(name)
        return "; ".join(f"{', '.join(those)}: {problem}" for problem, those in names.items())

    def close(self) -> None:
        """End the reading."""
        atexit.unregister(self.close)
        self._stop_event.set()
        deadline = time.monotonic() + _CLOSING
        for camera in self._cameras.values():
            camera.join(max(0.0, deadline - time.monotonic()))

    def _frame_set(self, after: FrameSet | None, is_running: bool, late: bool) -> FrameSet | None:
        """Return the frame set of the images that are there; None as long as an expected one is
        missing.
        """
        numbers = dict.fromkeys(self._cameras, -1) if after is None else after.numbers
        had_image = self._cameras.keys() if after is None else after.images.keys()
        new = {
            name: [shot for shot in camera.shots if shot.number > numbers[name]]
            for name, camera in self._cameras.items()
        }
        newest = max((shots[-1].time for shots in new.values() if shots), default=0.0)
        groups = {}
        for name, camera in self._cameras.items():
            # The first images have to be complete, and so have the last ones. Otherwise a camera
            # that runs is waited for, unless it is late or was missing before.
            is_awaited = after is None or not is_running or not (late or camera.reason)
            if new[name] and newest - new[name][-1].time <= _MAX_SKEW:
                groups[name] = new[name]
            elif is_awaited and name in had_image:
                return None
        if not groups:
            return None
        time_of_slowest = min(shots[-1].time for shots in groups.values())
        chosen = {
            name: min(shots, key=lambda shot: abs(shot.time - time_of_slowest))
            for name, shots in groups.items()
        }
        times = [shot.time for shot in chosen.values()]
        if max(times) - min(times) > _MAX_SKEW:
            return None
        skipped = min(shot.number - numbers[name] - 1 for name, shot in chosen.items())
        return FrameSet(
            {name: shot.image for name, shot in chosen.items()},
            {
                name: chosen.get(name, camera.shots[-1]).number
                for name, camera in self._cameras.items()
            },
            max(times),
            max(times) - min(times),
            0 if after is None else skipped,
        )

    def _wait_for_first(self) -> None:
        """Wait until every camera has had an image, and has adjusted its exposure.

        Raises:
            OSError, ValueError: one has none.
        """
        deadline = time.monotonic() + self._timeout
        cameras = self._cameras.items()
        while silent := {name: camera for name, camera in cameras if not camera.shots}:
            time_left = deadline - time.monotonic()
            for name, camera in silent.items():
                if camera.error is not None:
                    raise camera.error
                require(
                    camera.reason is None and time_left > 0,
                    "CameraFeed()",
                    f"expected images of {name}",
                    f"none ({camera.reason or 'it is silent'})",
                    "check that it records, or wait for it longer than "
                    f"{self._timeout:g} s (--timeout)",
                )
            self._change.wait(time_left)
        self._change.wait_for(self._stop_event.is_set, self._warm_up)


class _Camera(Thread):
    """Thread that reads the images of a camera; its state is guarded by `changed`."""

    def __init__(self, images: Iterable[np.ndarray | None], change: Condition, stop: Event) -> None:
        super().__init__(daemon=True, name="camera")
        self.shots: deque[Shot] = deque(maxlen=_KEPT)
        self.reason: str | None = None  # why there are no images any more
        self.error: Exception | None = None
        self._images = images
        self._change = change
        self._stop_event = stop

    def run(self) -> None:
        """Read until the source ends or the feed is closed."""
        number = 0
        reason = "it has ended"
        try:
            for image in self._images:
                if image is not None:
                    with self._change:
                        self.shots.append(Shot(image, time.monotonic(), number))
                        self._change.notify_all()
                    number += 1
                if self._stop_event.is_set():
                    break
        except Exception as error:
            self.error = error
            reason = str(error)
        finally:
            close_items(self._images)
            with self._change:
                self.reason = reason
                self._change.notify_all()
