"""A Dask cluster of two processes: the stream is the same, also when a worker or the scheduler is killed."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.runs.cluster.executor import open_workers, wait_for
from morgs_mi.runs.cluster.segments import SegmentedRun
from tests.runs.cluster.test_segments import FRAMES, SEGMENTS, SETTINGS, stream_of, when_fitted
from tests.scenes.recording import write_recording

distributed = pytest.importorskip("distributed", reason="comes with the extra `cluster`")


@pytest.fixture(autouse=True)
def short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("morgs_mi.runs.cluster.segments.TASK_FRAMES", 2)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return load_capture(write_recording(tmp_path_factory.mktemp("capture"), FRAMES))


@pytest.fixture(scope="module")
def whole(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The stream of processes without Dask."""
    out = tmp_path_factory.mktemp("whole")
    with open_workers(count=2) as workers:
        wait_for(SegmentedRun(capture, out, workers, SETTINGS, SEGMENTS).fit())
    return stream_of(out)


@pytest.fixture
def cluster() -> Iterator[subprocess.Popen[str]]:
    """A process with a scheduler and two workers, which prints the scheduler's address."""
    script = (
        "import sys\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(2, 1, dashboard_address=':0', silence_logs=50) as cluster:\n"
        "        print(cluster.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdin=-1, stdout=-1, text=True) as process:
        yield process
        process.communicate()


def address(cluster: subprocess.Popen[str]) -> str:
    assert cluster.stdout is not None
    return cluster.stdout.readline().strip()


def test_open_workers__connects_to_a_scheduler(cluster: subprocess.Popen[str]) -> None:
    with open_workers(address(cluster)) as workers:
        assert asyncio.run(workers.run(os.getpid)) not in (os.getpid(), cluster.pid)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 5])
def test_SegmentedRun__with_a_killed_dask_worker_is_the_same(
    capture: Capture, whole: bytes, cluster: subprocess.Popen[str], tmp_path: Path, count: int
) -> None:
    scheduler, killed = address(cluster), []
    with distributed.Client(scheduler, set_as_default=False) as client:

        def kill() -> None:
            """Kill a worker's process; its nanny starts a new one."""
            killed.append(list(client.run(os.getpid).values())[-1])
            os.kill(killed[-1], signal.SIGKILL)

        with open_workers(scheduler) as workers:
            wait_for(SegmentedRun(capture, tmp_path, workers, SETTINGS, SEGMENTS, when_fitted(count, kill)).fit())
    assert len(killed) == 1
    assert stream_of(tmp_path) == whole


@pytest.mark.slow
def test_SegmentedRun__names_a_lost_scheduler_and_is_resumed(
    capture: Capture, whole: bytes, cluster: subprocess.Popen[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("morgs_mi.runs.cluster.executor._TIMEOUT", 2)
    lost = when_fitted(4, cluster.kill)
    with (
        pytest.raises(
            ConnectionError, match=r"tcp://[\d.:]+: expected a scheduler that answers, .* lost; start it again"
        ),
        open_workers(address(cluster)) as workers,
    ):
        wait_for(SegmentedRun(capture, tmp_path, workers, SETTINGS, SEGMENTS, lost).fit())
    with open_workers(count=2) as workers:
        wait_for(SegmentedRun(capture, tmp_path, workers, SETTINGS, SEGMENTS).fit(resume=True))
    assert stream_of(tmp_path) == whole
