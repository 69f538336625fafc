"""The turntable: the pages' cameras orbit around the scene's centre."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from threading import Event, Thread
from typing import Any

import numpy as np

__all__ = ["Axis", "Turntable"]

# Seconds of a full turn, and between two views.
_TURN, _PERIOD = 20.0, 1 / 30


class Axis:
    """An axis and the cylindrical coordinates about it.

    Args:
        center: a point of the axis [3].
        up: its direction [3].
    """

    def __init__(self, center: np.ndarray, up: np.ndarray) -> None:
        self.center = np.asarray(center, np.float64)
        self._up = np.asarray(up, np.float64) / np.linalg.norm(up)
        across = np.cross(self._up, np.eye(3)[np.argmin(np.abs(self._up))])
        self._across = across / np.linalg.norm(across)
        self._along = np.cross(self._up, self._across)

    def azimuth(self, position: np.ndarray) -> float:
        """Return the angle of a position [3] about the axis in radians."""
        arm = position - self.center
        return float(np.arctan2(arm @ self._along, arm @ self._across))

    def at(self, position: np.ndarray, azimuth: float) -> np.ndarray:
        """Return the point [3] with the height and the distance of `position` [3] and another azimuth."""
        arm = position - self.center
        distance = np.hypot(arm @ self._along, arm @ self._across)
        direction = np.cos(azimuth) * self._across + np.sin(azimuth) * self._along
        return self.center + (arm @ self._up) * self._up + distance * direction


class Turntable:
    """Turntable of all pages, in a thread of its own, so that decoding does not stop it.

    The clock determines the azimuth. Distance and height are those of a page's camera, which may change meanwhile.

    Args:
        pages: returns the pages, viser's `ClientHandle`.
        axis: the axis of the orbits; the cameras look at its centre.
    """

    def __init__(self, pages: Callable[[], Iterable[Any]], axis: Axis) -> None:
        self._pages, self._axis = pages, axis
        self._stopped = Event()
        self._thread: Thread | None = None

    def turn(self, on: bool) -> None:
        """Turn, or leave the cameras where they are."""
        if on and self._thread is None:
            self._stopped.clear()
            self._thread = Thread(target=self._run, daemon=True)
            self._thread.start()
        elif not on and self._thread is not None:
            self._stopped.set()
            self._thread = None

    def _run(self) -> None:
        begin, starts = time.monotonic(), {}
        while not self._stopped.wait(_PERIOD):
            angle = 2 * np.pi * (time.monotonic() - begin) / _TURN
            for page in self._pages():
                camera = page.camera
                start = starts.setdefault(page.client_id, self._axis.azimuth(camera.position) - angle)
                with page.atomic():
                    camera.position = self._axis.at(camera.position, start + angle)
                    camera.look_at = self._axis.center
