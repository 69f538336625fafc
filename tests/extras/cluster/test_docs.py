"""The commands of the section on chunks in docs/captures.md run."""

import contextlib
import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from morgs_mi.cli.main import main
from morgs_mi.codec.reader import StreamReader
from tests.quick import OPTIONS
from tests.scenes.recording import write_recording

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "captures.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"<!-- (run|start) -->\n```\w+\n(.*?)```", TEXT, re.DOTALL)
FRAMES = 4


def started(command):
    """Start a command of Dask and wait until it listens."""
    program, *args = shlex.split(command)
    assert program == "dask"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *args], stderr=subprocess.PIPE, text=True, env=env
    )
    next(line for line in process.stderr if "Scheduler at:" in line or "Registered to:" in line)
    return process


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with a small capture where the demo writes its own."""
    write_recording(tmp_path / "out/demo/capture", FRAMES)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_chunks_section__commands_run(workplace):
    pytest.importorskip("distributed", reason="comes with the extra `cluster`")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    with contextlib.ExitStack() as stack:
        for kind, text in BLOCKS:
            command = text.strip().replace("8786", port)
            if kind == "start":
                process = started(command)
                stack.callback(process.wait)
                stack.callback(process.terminate)
            else:
                program, *args = shlex.split(command)
                assert program == "morgs-mi"
                assert main([*args, *(OPTIONS if args[0] == "fit" else [])]) == 0, command
    streams = sorted(
        str(path.parent.relative_to("out")) for path in Path("out").rglob("stream.morgs")
    )
    assert streams == ["chunks", "cluster"]
    for name in streams:
        assert {frame for _, frame, _ in StreamReader(f"out/{name}/stream.morgs").index()} == set(
            range(FRAMES)
        )


def test_chunks_section__has_commands():
    kinds = ["run", "start", "start", "run"]
    assert [kind for kind, _ in BLOCKS] == kinds
