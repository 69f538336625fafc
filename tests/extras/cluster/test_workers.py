"""Workers: what they run, what happens when they die, and the sentences of what cannot be."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from morgs_mi.extras.cluster.workers import num_workers, open_client, prepared, worker_name
from morgs_mi.platform.threads import usable_cores

distributed = pytest.importorskip("distributed", reason="comes with the extra `cluster`")


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def fail():
    raise ValueError("fail(): expected more.")


def threads(*tasks):
    import drjit as dr

    with prepared(*tasks):
        return dr.thread_count(), worker_name()


@pytest.mark.slow
def test_open_client__starts_workers_that_share_the_cores():
    import mitsuba as mi

    from morgs_mi.extras.cluster.workers import installed

    with open_client(count=2) as client:
        assert num_workers(client) == 2
        count, name = client.submit(threads, str(mi.variant()), installed()).result()
        assert count == max(1, usable_cores() // 2)
        assert name in client.scheduler_info(n_workers=-1)["workers"]
        with pytest.raises(ValueError, match=r"^fail\(\): expected more\.$"):
            client.submit(fail).result()


@pytest.mark.slow
def test_open_client__starts_workers_that_import_nothing_of_the_current_folder(
    tmp_path, monkeypatch
):
    (tmp_path / "multiprocessing.py").write_text("open('executed', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with open_client(count=1) as client:
        assert set(client.run(lambda: __import__("sys").flags.safe_path).values()) == {True}
    assert not os.environ["PYTHONSAFEPATH"], "processes of the caller are as before"
    assert not Path("executed").exists()


@pytest.mark.slow
def test_open_client__names_workers_that_die():
    import dask.config

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        pytest.raises(
            ChildProcessError,
            match="this machine: expected the workers to stay alive, but all died that",
        ),
        open_client(count=1) as client,
    ):
        client.submit(die).result()


@pytest.mark.slow
def test_open_client__has_workers_that_end_with_their_parent():
    script = (
        "import os, signal\n"
        "from morgs_mi.extras.cluster.workers import open_client\n"
        "if __name__ == '__main__':\n"
        "    with open_client(count=1) as client:\n"
        "        print(client.submit(os.getpid).result(), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=False
    )
    deadline = time.monotonic() + 20
    while Path(f"/proc/{result.stdout.strip()}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_open_client__refuses_in_one_sentence(monkeypatch):
    monkeypatch.setattr("morgs_mi.extras.cluster.workers.TIMEOUT", 1)
    for scheduler in ("here", "tcp://127.0.0.1:1"):
        message = f"{scheduler}: expected a scheduler with workers, got none"
        with pytest.raises((ValueError, ConnectionError), match=message), open_client(scheduler):
            pass


def test_open_client__names_the_extra_that_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ValueError, match=r"need the package distributed; pip .*morgs-mi\[cluster\]"),
        open_client(),
    ):
        pass
