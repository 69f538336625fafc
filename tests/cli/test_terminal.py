"""What the commands print on terminals of 80 and 100 columns."""

from __future__ import annotations

import fcntl
import itertools
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import COMMANDS, main

NAMES = [(), *((name,) for name in COMMANDS), *(("export", name) for name in EXPORTS)]


def parts_on_terminal(columns: int, *args: str | Path) -> Iterator[bytes]:
    """Yield what a command prints on a terminal, when it does."""
    parent, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k != "COLUMNS"} | {"TERM": "xterm"}
    command = [sys.executable, "-m", "morgs_mi", *map(str, args)]
    with subprocess.Popen(command, stdin=child, stdout=child, stderr=child, env=environment):
        os.close(child)
        with suppress(OSError):  # the process has ended
            while part := os.read(parent, 2**16):
                yield part
    os.close(parent)


def on_terminal(columns: int, *args: str | Path) -> str:
    """Return what a command prints on a terminal, with its colours."""
    return b"".join(parts_on_terminal(columns, *args)).decode().replace("\r", "\n")


@pytest.mark.parametrize("columns", [80, 100])
@pytest.mark.parametrize("command", NAMES)
def test_help__fits_the_terminal_without_orphan_lines(command, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    assert not re.search(r"\(default:\s*(None)?\)|\b(STR|NONETYPE)\b", "\n".join(lines))
    for line, following in itertools.pairwise(lines):
        indent = len(following) - len(following.lstrip())
        # A line of the same paragraph begins with a word that did not fit.
        if indent > 10 and line[: indent - 1].isspace() and line[indent : indent + 1].strip():
            assert len(line) + 1 + len(following.split()[0]) > columns - 2, following


@pytest.mark.slow
@pytest.mark.parametrize("columns", [80, 100])
def test_commands__print_whole_words_on_a_terminal(columns, fitted_clip, tmp_path):
    for args in (
        ("info", fitted_clip / "capture"),
        ("eval", fitted_clip, "--frames", "2"),
        ("render", fitted_clip, tmp_path / "long-name-of-a-folder-of-images-png", "--camera", "0"),
        ("fit", fitted_clip / "missing", tmp_path / "out"),
    ):
        colored_text = on_terminal(columns, *args)
        verdict = r"\x1b\[3[123]mViews between the cameras will be (good|fair|poor):"
        assert (args[0] == "info") == bool(re.search(verdict, colored_text))
        text = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", colored_text)
        assert text.strip()
        # Only a path that is longer than the terminal is broken.
        lines = [line for line in text.splitlines() if " " in line.strip()]
        assert max(map(len, lines)) <= columns, text
        assert "Traceback" not in text


QUICK_SWEEP = "--presets default --epochs 1 --first-frame-steps 60 --seeds 1 --frames 2"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words"), [("fit", ""), ("sweep", QUICK_SWEEP)])
def test_bars__change_a_cell_within_ten_seconds(name, words, fitted_clip, tmp_path):
    config = tmp_path / "few.toml"
    config.write_text("fit.num_gaussians = 500\nfit.first_frame_steps = 100\n")
    places = (fitted_clip / "capture", tmp_path / "out")
    options = [*words.split(), "--config", config]
    shown = ""
    gaps = []
    begin = time.monotonic()
    for part in parts_on_terminal(100, name, *places, *options):
        text = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", part.decode(errors="replace"))
        if text != shown:
            gaps.append(time.monotonic() - begin)
            begin = time.monotonic()
        shown = text
    assert (places[1] / {"fit": "report.json", "sweep": "sweep.json"}[name]).exists()
    assert max(gaps) < 10
