"""Images of files, connections and cameras of this machine as they arrive."""

from __future__ import annotations

import time
from collections.abc import Generator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.io.video_writer import write_video
from morgs_mi.live import reading as module
from morgs_mi.live.reading import read_camera

IMAGE = np.zeros((4, 6, 3), np.uint8)


def test_read_camera__plays_a_file_at_its_own_speed(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mkv", [IMAGE] * 6, 20)
    start = time.monotonic()
    times = [time.monotonic() - start for image in read_camera(tmp_path / "clip.mkv") if image is not None]
    assert len(times) == 6
    assert times[-1] >= 5 / 20 - 0.01
    assert np.all(np.diff(times) > 0.02), "not all at once"


def test_read_camera__opens_a_broken_connection_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PAUSE", 0)
    monkeypatch.setattr(module, "_RETRY", 0)
    opened = []

    class Connection:
        """Delivers two images."""

        left = 2

        def read(self):
            self.left -= 1
            return self.left >= 0, IMAGE

        def release(self) -> None:
            opened.append("released")

    def open_source(source: str) -> Connection:
        opened.append(source)
        if len(opened) == 3:
            raise OSError("it is not there")
        return Connection()

    monkeypatch.setattr(module, "open_source", open_source)
    url = "rtsp://10.0.0.10/live"
    found = list(islice(read_camera(url), 16))
    assert sum(image is not None for image in found) == 4
    assert opened[:4] == [url, "released", url, url]
    assert sum(image is not None for image in read_camera("pipe")) == 2, "a pipe ends"


def test_read_camera__requests_the_size_of_a_camera_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    requested = {}

    class Camera:
        def set(self, key: int, value: float) -> None:
            requested[key] = value

        def read(self):
            return True, IMAGE + np.array([1, 2, 3], np.uint8)

        def release(self) -> None:
            requested["released"] = True

    monkeypatch.setattr(module, "open_source", lambda source: Camera())
    images = read_camera(0, (640, 480))
    image = next(images)
    assert image is not None
    assert image[0, 0].tolist() == [3, 2, 1], "RGB"
    assert isinstance(images, Generator)
    images.close()
    assert requested == {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480, "released": True}
