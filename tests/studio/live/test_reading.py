"""Images of connections and cameras of this machine as they arrive."""

from __future__ import annotations

from collections.abc import Generator
from itertools import islice
from threading import Event

import cv2
import numpy as np
import pytest

from morgs_mi.studio.live import sources as module
from morgs_mi.studio.live.sources import read_camera

IMAGE = np.zeros((4, 6, 3), np.uint8)


class Connection:
    """Delivers two images."""

    def __init__(self) -> None:
        self.left = 2

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, np.ndarray]:
        self.left -= 1
        return self.left >= 0, IMAGE

    def release(self) -> None:
        pass


class Missing(Connection):
    """Cannot be opened."""

    def isOpened(self) -> bool:
        return False


def test_read_camera__opens_a_broken_connection_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSE", 0)
    monkeypatch.setattr(module, "RETRY", 0)
    opened = []

    def open_stream(source: str, *_: object) -> Connection:
        opened.append(source)
        return Missing() if len(opened) == 2 else Connection()

    monkeypatch.setattr(cv2, "VideoCapture", open_stream)
    url = "rtsp://10.0.0.10/live"
    images = list(islice(read_camera(url, Event()), 16))
    assert sum(image is not None for image in images) == 4
    assert opened == [url] * 3
    for once in (read_camera(url, Event(), reconnect=False), read_camera("cam.sdp", Event())):
        assert sum(image is not None for image in once) == 2
    closed = Event()
    closing = read_camera(url, closed)
    assert next(closing) is not None
    closed.set()
    assert list(closing) == []


def test_read_camera__requests_the_size_of_a_camera_of_this_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    requested = {}

    class Camera:
        def isOpened(self) -> bool:
            return True

        def set(self, key: int, value: float) -> None:
            requested[key] = value

        def read(self):
            return True, IMAGE + np.array([1, 2, 3], np.uint8)

        def release(self) -> None:
            requested["released"] = True

    monkeypatch.setattr(cv2, "VideoCapture", lambda source: Camera())
    images = read_camera(0, Event(), (640, 480))
    image = next(images)
    assert image is not None
    assert image[0, 0].tolist() == [3, 2, 1], "RGB"
    assert isinstance(images, Generator)
    images.close()
    assert requested == {
        cv2.CAP_PROP_FRAME_WIDTH: 640,
        cv2.CAP_PROP_FRAME_HEIGHT: 480,
        "released": True,
    }
