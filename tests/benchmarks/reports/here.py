"""A worker without a process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def client_here() -> Iterator[Any]:
    """Yield the client of a worker that is a thread of this process."""
    distributed = pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None, set_as_default=False
    ) as client:
        yield client
