"""Images of connections and cameras of this machine as they arrive."""

from collections.abc import Generator
from itertools import islice
from threading import Event
from unittest.mock import Mock, call

import cv2
import numpy as np

from morgs_mi.extras.live import sources as module
from morgs_mi.extras.live.sources import read_camera, read_once
from tests.scenes.live_clip import connection

IMAGE = np.zeros((4, 6, 3), np.uint8)


def test_read_camera__opens_a_broken_connection_again(monkeypatch):
    monkeypatch.setattr(module, "RETRY", 0)
    url = "rtsp://10.0.0.10/live"
    missing = connection(opens=False)
    opens = Mock(side_effect=[connection(IMAGE, IMAGE), missing, connection(IMAGE, IMAGE)])
    monkeypatch.setattr(cv2, "VideoCapture", opens)
    images = list(islice(read_camera(url, Event()), 16))  # ten reads fail before the next attempt
    assert sum(image is not None for image in images) == 4
    assert [call.args[0] for call in opens.call_args_list] == [url] * 3
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: connection(IMAGE, IMAGE))
    assert sum(image is not None for image in read_once(url, Event())) == 2
    closed = Event()
    closing = read_camera(url, closed)
    assert next(closing) is not None
    closed.set()
    assert list(closing) == []


def test_read_once__continues_after_a_failed_read(monkeypatch):
    camera = connection(IMAGE, IMAGE)
    camera.read.side_effect = [(True, IMAGE), (False, None), (True, IMAGE), *[(False, None)] * 99]
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: camera)
    images = [image is not None for image in read_once(0, Event())]
    assert images == [True, False, True] + 10 * [False]


def test_read_camera__requests_the_size_of_a_camera_of_this_machine(monkeypatch):
    camera = connection(IMAGE + np.array([1, 2, 3], np.uint8))
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: camera)
    images = read_camera(0, Event(), (640, 480))
    image = next(images)
    assert image[0, 0].tolist() == [3, 2, 1], "RGB"
    assert isinstance(images, Generator)
    images.close()
    assert camera.set.call_args_list == [
        call(cv2.CAP_PROP_FRAME_WIDTH, 640),
        call(cv2.CAP_PROP_FRAME_HEIGHT, 480),
    ]
    camera.release.assert_called()
