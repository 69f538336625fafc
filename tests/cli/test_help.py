"""`morgs-mi --version`, completion of a shell, and commands and presets that are listed."""

import os
import subprocess
import sys
from importlib.metadata import version
from typing import get_args

import pytest

from morgs_mi.cli.main import main
from morgs_mi.loop.stream_config import PresetName


def test_main__prints_the_version(run):
    assert run("--version") == (0, f"morgs-mi {version('morgs-mi')}\n", "")


def test_main__names_standard_output_if_the_version_does_not_fit(run, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert run("--version")[::2] == (1, "standard output: No space left on device.\n")


def test_main__ends_silently_if_the_reader_of_its_output_has():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "morgs_mi", "--help"]
    result = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, b"")


def test_main__writes_the_completion_of_a_shell(tmp_path):
    with pytest.raises(SystemExit) as stop:
        main(["--tyro-write-completion", "bash", str(tmp_path / "morgs-mi.bash")])
    assert not stop.value.code
    assert "morgs-mi" in (tmp_path / "morgs-mi.bash").read_text()


@pytest.mark.parametrize(
    ("words", "commands"),
    [(["export", "plly", "out"], "ply, video, web, gltf, usd")],
)
def test_main__lists_the_commands_in_place_of_a_mistyped_one(words, commands, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert commands in capsys.readouterr().err


def test_fit__lists_all_presets_in_its_help(capsys):
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    shown = text.partition("--preset NAME")[2].partition("--config")[0].replace(",", " ").split()
    assert set(get_args(PresetName)) <= set(shown)
