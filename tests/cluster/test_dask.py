"""A Dask cluster of two processes: the stream is the same, also when a worker or the scheduler is killed."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.executor import open_workers
from morgs_mi.cluster.segments import stream_segments
from tests.cluster.test_segments import FRAMES, SEAMS, SETTINGS, stream_of, when_fitted
from tests.scenes.recording import write_recording

distributed = pytest.importorskip("distributed", reason="comes with the extra `cluster`")


@pytest.fixture(autouse=True)
def short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("morgs_mi.cluster.segments.TASK_FRAMES", 2)


def kill_worker(dask_worker=None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_open_workers__connects_to_a_scheduler_and_names_a_lost_one() -> None:
    with distributed.LocalCluster(1, 1, dashboard_address=":0", silence_logs=50) as cluster:
        with open_workers(cluster.scheduler_address) as workers:
            assert workers.count == 1
            assert asyncio.run(workers.run(os.getpid)) != os.getpid()


@pytest.mark.slow
def test_stream_segments__on_dask_with_killed_workers_is_the_same(tmp_path: Path) -> None:
    capture = load_capture(write_recording(tmp_path / "capture", FRAMES))
    with open_workers(count=2) as workers:
        stream_segments(capture, tmp_path / "whole", workers, SETTINGS, 3, SEAMS)
    cluster = distributed.LocalCluster(2, 1, dashboard_address=":0", silence_logs=50)
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        killed = []

        def kill() -> None:
            """Kill the worker processes; their nannies start new ones."""
            pids = list(client.run(os.getpid).values())
            os.kill(pids[len(killed) % 2], signal.SIGKILL)
            killed.append(pids)

        with open_workers(cluster.scheduler_address) as workers:
            for count in (2, 5):
                out = tmp_path / f"{count}"
                stream_segments(capture, out, workers, SETTINGS, 3, SEAMS, on_stage=when_fitted(count, kill))
                assert stream_of(out) == stream_of(tmp_path / "whole")
    assert len(killed) == 2
