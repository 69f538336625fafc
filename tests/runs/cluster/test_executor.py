"""Workers: what they run, what happens when they die, and the sentences of what cannot be."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from morgs_mi.runs.cluster.executor import cores, open_workers, share_of_machine


def add(a: int, b: int) -> int:
    return a + b


def die_once(mark: str) -> int:
    """Kill the process, unless an earlier one has left a mark."""
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail() -> None:
    raise ValueError("fail(): expected more.")


def share() -> tuple[int, int]:
    return share_of_machine()


async def all_of(workers, *calls) -> list:
    return await asyncio.gather(*(workers.run(*call) for call in calls), return_exceptions=True)


def test_workers__repeat_what_a_dead_process_was_doing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One task dies each time; it alone fails, and the workers go on."""
    monkeypatch.setattr("morgs_mi.runs.cluster.executor._ATTEMPTS", 2)
    with open_workers(count=2) as workers:
        calls = [(die,), (add, 1, 2), (die_once, str(tmp_path / "mark")), (fail,)]
        dead, total, pid, failed = asyncio.run(all_of(workers, *calls))
        assert isinstance(dead, ChildProcessError)
        assert "2 processes died at the same task" in str(dead)
        assert (total, str(failed)) == (3, "fail(): expected more.")
        assert pid != os.getpid()
        assert asyncio.run(workers.run(add, 2, 3)) == 5


def test_workers__share_the_machine() -> None:
    with open_workers(count=2) as workers:
        threads, memory = asyncio.run(workers.run(share))
    assert threads == max(1, cores() // 2)
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory == total // 2


def test_workers__end_with_their_parent() -> None:
    script = (
        "import asyncio, os, signal\n"
        "from morgs_mi.runs.cluster.executor import open_workers\n"
        "if __name__ == '__main__':\n"
        "    with open_workers(count=1) as workers:\n"
        "        print(asyncio.run(workers.run(os.getpid)), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    deadline = time.monotonic() + 5
    while Path(f"/proc/{result.stdout.strip()}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("scheduler", "count", "message"),
    [
        (None, 0, r"`workers` must be at least 1, got 0"),
        ("here", None, r"`scheduler` must be local or an address such as tcp://host:8786, got here"),
        ("nothing://here", None, r"nothing://here: expected a scheduler with workers, got none"),
        ("tcp://127.0.0.1:1", None, r"tcp://127\.0\.0\.1:1: expected a scheduler with workers, got none"),
    ],
)
def test_open_workers__refuses_in_one_sentence(scheduler, count, message, monkeypatch: pytest.MonkeyPatch) -> None:
    if scheduler:
        pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    monkeypatch.setattr("morgs_mi.runs.cluster.executor._TIMEOUT", 1)
    with pytest.raises((ValueError, ConnectionError), match=message), open_workers(scheduler, count):
        pass


def test_open_workers__names_the_extra_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ValueError, match=r"`scheduler=local` needs the package distributed; pip .*morgs-mi\[cluster\]"),
        open_workers("local"),
    ):
        pass


def test_workers_map__awaits_at_most_as_many_items_as_there_are_workers() -> None:
    running, most, done = set[int](), [], []

    async def note(item: int) -> None:
        running.add(item)
        most.append(len(running))
        await asyncio.sleep(0.01 * (3 - item))
        running.discard(item)
        done.append(item)

    with open_workers(count=2) as workers:
        asyncio.run(workers.map(note, range(3)))
    assert (max(most), sorted(done)) == (2, [0, 1, 2])


def test_workers_map__raises_the_first_error_and_cancels_the_others() -> None:
    ended = []

    async def fail_or_wait(item: int) -> None:
        if item:
            raise ConnectionError("lost")
        try:
            await asyncio.sleep(60)
        finally:
            ended.append(item)

    with open_workers(count=2) as workers, pytest.raises(ConnectionError, match="lost"):
        asyncio.run(workers.map(fail_or_wait, range(4)))
    assert ended == [0]
