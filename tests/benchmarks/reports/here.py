"""A worker without a process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import drjit as dr
import pytest


@contextmanager
def client_here() -> Iterator[Any]:
    """Yield the client of a worker that is a thread of this process; its number of threads is
    restored.

    With one thread of Dr.Jit, Mitsuba waits forever when it reads or writes an EXR file.
    """
    distributed = pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    threads = dr.thread_count(), cv2.getNumThreads()
    try:
        with distributed.Client(
            processes=False,
            n_workers=1,
            threads_per_worker=1,
            dashboard_address=None,
            set_as_default=False,
        ) as client:
            yield client
    finally:
        dr.set_thread_count(threads[0])
        cv2.setNumThreads(threads[1])
