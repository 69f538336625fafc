"""Images of cameras that are read side by side: the newest ones that agree best in time, and what
faults do.
"""

import time
from queue import SimpleQueue
from threading import Timer

import numpy as np
import pytest

from morgs_mi.extras.live.cameras import CameraFeed
from tests.scenes.programs import run_script

IMAGE = np.zeros((4, 6, 3), np.uint8)


class Source:
    """A camera that delivers an image whenever the test requests it; None ends it, an error is
    raised.
    """

    def __init__(self, shots=0):
        self._images = SimpleQueue()
        self.deliver(shots)

    def deliver(self, count=1):
        for _ in range(count):
            self._images.put(IMAGE)

    def end(self, error=None):
        self._images.put(error)

    def __iter__(self):
        while (image := self._images.get()) is not None:
            if isinstance(image, Exception):
                raise image
            yield image


@pytest.fixture
def opened():
    """Feeds that are closed in the end, with their sources."""
    feeds = []

    def open_feed(*shots, timeout=1.0, warm_up=0.0):
        sources = [Source(count) for count in shots]
        cameras = {f"cam{k}": source for k, source in enumerate(sources)}
        feeds.append((CameraFeed(cameras, timeout, warm_up), sources))
        return feeds[-1]

    yield open_feed
    for feed, sources in feeds:
        for source in sources:
            source.end()
        feed.close()


def wait_for(feed, *counts):
    """Wait until the threads have read that many images."""
    for camera, count in zip(feed._cameras.values(), counts, strict=True):
        while not camera.shots or camera.shots[-1].number < count - 1:
            time.sleep(0.001)


def numbers(frame_set):
    """Return the number of each camera's image, in their order."""
    return [*frame_set.numbers.values()]


def test_CameraFeed__skips_what_arrived_during_a_fit(opened):
    feed, (a, b) = opened(1, 1)
    first = feed.newest()
    assert (numbers(first), first.dropped) == ([0, 0], 0)
    a.deliver(7)
    b.deliver(9)
    wait_for(feed, 8, 10)
    second = feed.newest(first)
    ahead = np.array((7, 9)) - numbers(second)
    assert ahead.min() == 0, "the newest of one camera"
    assert ahead.max() < 4
    assert second.dropped == min(numbers(second)) - 1, "of the camera that dropped fewer"
    assert second.time >= first.time
    assert 0 <= second.skew < 0.5


def test_CameraFeed__waits_for_new_images_of_all(opened):
    feed, (a, b) = opened(1, 1, timeout=5)
    first = feed.newest()
    a.deliver()
    wait_for(feed, 2, 1)
    b.deliver()
    assert numbers(feed.newest(first)) == [1, 1]


def test_CameraFeed__leaves_out_a_silent_camera_until_it_is_back(opened):
    feed, (a, b) = opened(1, 1)
    first = feed.newest()
    a.deliver()
    start = time.monotonic()
    second = feed.newest(first)
    waited = time.monotonic()
    a.deliver()
    third = feed.newest(second)
    assert waited - start >= 1
    assert time.monotonic() - waited < 1, "it is not waited for again"
    assert list(second.images) == list(third.images) == ["cam0"]
    assert feed.problem("cam1") == "no image for 1 s"
    a.deliver()
    b.deliver()
    wait_for(feed, 4, 2)
    assert numbers(feed.newest(third)) == [3, 1]


def test_CameraFeed__leaves_out_a_camera_that_ends_at_once_and_ends_with_the_last(opened):
    feed, (a, b) = opened(1, 1, timeout=60)
    first = feed.newest()
    b.end(ValueError("cable pulled"))
    a.deliver()
    second = feed.newest(first)
    assert list(second.images) == ["cam0"]
    assert feed.problem("cam1") == "cable pulled"
    a.end()
    assert feed.newest(second) is None
    assert feed.problem("cam0") == "it has ended"


def test_CameraFeed__names_a_camera_without_a_first_image(opened):
    feed, (_, b) = opened(1, 0)
    with pytest.raises(
        ValueError, match=r"images of cam1, got none \(it is silent\); .* longer than 1 s"
    ):
        feed.newest()
    b.end()
    failing, (_, c) = opened(1, 0, timeout=60)
    c.end(OSError("cannot open the source 63"))
    with pytest.raises(OSError, match="cannot open the source 63"):
        failing.newest()


def test_CameraFeed__lets_the_cameras_adjust_their_exposure(opened):
    feed, (a, b) = opened(1, 0, timeout=5, warm_up=0.8)
    start = time.monotonic()
    Timer(0.1, b.deliver).start()
    Timer(0.2, lambda: (a.deliver(), b.deliver())).start()
    first = feed.newest()
    assert time.monotonic() - start >= 0.9
    assert (numbers(first), first.dropped) == ([1, 1], 0)


def test_CameraFeed__refuses_images_of_different_times(opened):
    feed, (a, b) = opened(1, 0, timeout=60)
    a.end()
    Timer(1.0, lambda: (b.deliver(), b.end())).start()
    with pytest.raises(
        ValueError, match=r"simultaneous images of cam0, cam1, got none that arrived within 0.5 s"
    ):
        feed.newest()


@pytest.mark.slow
def test_CameraFeed__is_closed_when_the_interpreter_ends():
    """A thread that executes library code after the end of the interpreter aborts the process."""
    script = """
from threading import Event
import numpy as np
from morgs_mi.extras.live.cameras import CameraFeed

def images():
    yield np.zeros((4, 6, 3), np.uint8)
    closed.wait()
    print("closed")

closed = Event()
CameraFeed({"cam0": images()}, 5, closed=closed).newest()
"""
    result = run_script(script, check=True)
    assert result.stdout == "closed\n"
