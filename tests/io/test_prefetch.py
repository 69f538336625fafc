"""Prefetching in the background: order, bound, errors, and no thread that remains."""

import threading
import time

import pytest

from morgs_mi.io.prefetch import prefetched
from tests.scenes.programs import run_script


def wait_until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def workers():
    return sum(thread.name == "prefetch" for thread in threading.enumerate())


def test_prefetched__preserves_the_order_and_runs_in_another_thread():
    made_by = set()

    def items():
        for i in range(20):
            made_by.add(threading.current_thread().name)
            yield i

    assert list(prefetched(items())) == list(range(20))
    assert made_by == {"prefetch"}
    wait_until(lambda: workers() == 0)


def test_prefetched__produces_a_bounded_number_of_items_ahead():
    made = []

    def items():
        for i in range(100):
            made.append(i)
            yield i

    ahead = prefetched(items(), ahead=3)
    assert next(ahead) == 0
    wait_until(lambda: len(made) >= 5)
    time.sleep(0.2)
    assert made == [0, 1, 2, 3, 4]  # one is in use, three wait, one is being handed over
    ahead.close()
    wait_until(lambda: workers() == 0)


def test_prefetched__raises_an_error_in_place_of_the_item():
    def items():
        yield 1
        raise ValueError("the disk is gone")

    ahead = prefetched(items())
    assert next(ahead) == 1
    with pytest.raises(ValueError, match="the disk is gone"):
        next(ahead)


def test_prefetched__closes_the_source():
    closed = []

    def items():
        try:
            while True:
                yield 0
        finally:
            closed.append(True)

    ahead = prefetched(items())
    next(ahead)
    ahead.close()
    wait_until(lambda: closed == [True])


def test_prefetched__yields_the_newest_item_of_a_source_that_cannot_wait():
    made = []
    release = threading.Event()

    def items():
        for i in range(50):
            made.append(i)
            yield i
            release.wait(10)

    ahead = prefetched(items(), newest=True)
    assert next(ahead) == 0
    release.set()
    wait_until(lambda: len(made) == 50)
    time.sleep(0.02)
    assert list(ahead) == [49]


def test_prefetched__lets_the_interpreter_end_while_an_item_is_produced():
    """A thread that resumes in library code after the end of the interpreter aborts the process."""
    script = (
        "import cv2, numpy as np\n"
        "from morgs_mi.io.prefetch import prefetched\n"
        "image = np.zeros((500, 500, 3), np.uint8)\n"
        "frames = prefetched((cv2.medianBlur(image, 31) for _ in range(10000)), ahead=10000)\n"
        "next(frames)\n"
        "raise SystemExit(3)\n"
    )
    result = run_script(script)
    assert (result.returncode, result.stderr) == (3, "")
