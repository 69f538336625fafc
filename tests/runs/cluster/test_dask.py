"""A Dask scheduler in another process: the stream is the same, also when it is killed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from morgs_mi.capture.capture import Capture
from morgs_mi.runs.cluster.chunks import ChunkedRun
from morgs_mi.runs.cluster.workers import open_client
from tests.runs.cluster import test_chunks
from tests.runs.cluster.test_chunks import CHUNKS, SETTINGS, stream_of, when_fitted

pytest.importorskip("distributed", reason="comes with the extra `cluster`")


capture = test_chunks.capture
short_tasks = test_chunks.short_tasks


@pytest.fixture(scope="module")
def whole(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The stream of workers that are started for it."""
    out = tmp_path_factory.mktemp("whole")
    with open_client(count=2) as client:
        ChunkedRun(capture, out, client, SETTINGS, CHUNKS).fit()
    return stream_of(out)


@pytest.fixture
def cluster() -> Iterator[subprocess.Popen[str]]:
    """A process with a scheduler and two workers, which prints the scheduler's address."""
    script = (
        "import sys\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=':0', "
        "silence_logs=50) as it:\n"
        "        print(it.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=-1, stdout=-1, text=True
    ) as process:
        yield process
        process.communicate()


def address(cluster: subprocess.Popen[str]) -> str:
    assert cluster.stdout is not None
    return cluster.stdout.readline().strip()


@pytest.mark.slow
def test_ChunkedRun__names_a_lost_scheduler_and_is_resumed(
    capture: Capture,
    whole: bytes,
    cluster: subprocess.Popen[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("morgs_mi.runs.cluster.workers.TIMEOUT", 2)
    lost = when_fitted(4, cluster.kill)
    with (
        pytest.raises(
            ConnectionError,
            match=r"tcp://[\d.:]+: expected a scheduler that answers, .* lost; start it again",
        ),
        open_client(address(cluster)) as client,
    ):
        ChunkedRun(capture, tmp_path, client, SETTINGS, CHUNKS, lost).fit()
    with open_client(count=2) as client:
        ChunkedRun(capture, tmp_path, client, SETTINGS, CHUNKS).fit(resume=True)
    assert stream_of(tmp_path) == whole
