"""Images of pipes, connections and cameras of this machine as they arrive."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import nullcontext, suppress
from itertools import islice
from pathlib import Path
from threading import Event, Thread

import cv2
import numpy as np
import pytest

from morgs_mi.io.video_writer import write_video
from morgs_mi.studio.live import reading as module
from morgs_mi.studio.live.reading import read_camera

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
    for once in (read_camera(url, Event(), reconnect=False), read_camera("pipe", Event())):
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


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """A named pipe without a writer."""
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


@pytest.mark.parametrize("written", [0, 2000, 40_000])
def test_read_camera__of_a_silent_pipe_ends_when_it_is_closed(
    pipe: Path, tmp_path: Path, written: int
) -> None:
    """Before its writer begins, within the header, and after some images."""
    write_video(
        tmp_path / "clip.mkv",
        list(np.random.default_rng(0).integers(0, 256, (9, 64, 64, 3), np.uint8)),
        20,
    )
    closed = Event()
    images = []
    reader = Thread(target=lambda: images.extend(read_camera(pipe, closed)), daemon=True)
    with os.fdopen(os.open(pipe, os.O_RDWR), "wb", 0) if written else nullcontext() as writer:
        reader.start()
        if writer is not None:
            writer.write((tmp_path / "clip.mkv").read_bytes()[:written])
        time.sleep(0.5)
        assert reader.is_alive()
        assert bool(images) == (written == 40_000)
        closed.set()
        reader.join(2)
        assert not reader.is_alive()


def test_read_camera__of_a_pipe_with_something_else_ends_with_an_error(pipe: Path) -> None:
    ended = Event()

    def write() -> None:
        with suppress(BrokenPipeError), pipe.open("wb", 0) as writer:
            writer.write(bytes(8_000_000))  # more than FFmpeg examines
            ended.wait(10)

    Thread(target=write, daemon=True).start()
    with pytest.raises(OSError, match=f"cannot open the source {pipe}; check that it exists"):
        list(read_camera(pipe, Event()))
    ended.set()


@pytest.mark.slow
def test_read_camera__lets_the_interpreter_end_while_it_waits_for_a_pipe(
    pipe: Path, tmp_path: Path
) -> None:
    """A thread that returns from OpenCV after the end of the interpreter aborts the process."""
    write_video(tmp_path / "clip.mkv", [IMAGE] * 6, 20)
    script = f"""
import os, time
from morgs_mi.studio.live.live_config import LiveConfig
from morgs_mi.studio.live.sources import open_feed

class Writer:
    def __del__(self, os=os, sleep=time.sleep):
        pipe = os.open({str(pipe)!r}, os.O_RDWR)
        os.write(pipe, data)
        os.close(pipe)
        sleep(1)

data = open({str(tmp_path / "clip.mkv")!r}, "rb").read()
writer = Writer()
open_feed([{str(pipe)!r}], LiveConfig(timeout=0.3)).newest()
"""
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert "or wait for it longer than 0.3 s (--timeout).\n" in result.stderr
