"""`morgs-mi --version`, `--completion`, and the command that a mistyped one resembles."""

from __future__ import annotations

import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import pytest

from morgs_mi import cli
from morgs_mi.cli.completion import near_command
from morgs_mi.loop.stream_config import PresetName

# Prints what bash would replace the last word by.
TRY = """
source completion.bash
COMP_WORDS=({words})
COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_tyro_morgs_mi
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def test_main__prints_the_version(run) -> None:
    assert run("--version") == (0, f"morgs-mi {version('morgs-mi')}\n", "")


def test_main__names_standard_output_if_the_version_does_not_fit(run, monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert run("--version")[::2] == (1, "standard output: No space left on device.\n")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("morgs-mi fi", {"fit"}),
        ("morgs-mi export w", {"web"}),
        ("morgs-mi fit capture out --pres", {"--preset"}),
        ("morgs-mi fit --preset ml", {"ml", "ml-mo", "ml-mo-mc"}),
        ("morgs-mi info cli", {"clip"}),
        ("morgs-mi fit clip out --config a", {"a.toml"}),
    ],
)
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_completion_script__completes_in_bash(tmp_path: Path, run, words: str, expected: set[str]) -> None:
    (tmp_path / "completion.bash").write_text(run("--completion", "bash")[1])
    (tmp_path / "clip").mkdir()
    (tmp_path / "a.toml").touch()
    command = ["bash", "-c", TRY.format(words=words)]
    printed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert set(printed.stdout.split()) == expected


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script__falls_back_on_files_in_every_shell(run, shell: str) -> None:
    status, script, _ = run("--completion", shell)
    assert (status, script.count("or ['__TYRO_COMPLETE_FILES__']")) == (0, 1)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["fti"], ["fit"]),
        (["evaluate"], ["eval"]),
        (["exprot", "ply"], ["export"]),
        (["export", "plly", "out"], ["export", "ply"]),
        (["export", "ply", "outt"], []),
        (["fit", "capture"], []),
        (["xyz"], []),
        ([], []),
    ],
)
def test_near_command__follows_commands_and_formats(words: list[str], expected: list[str]) -> None:
    assert near_command(cli.Options, words) == expected


def test_main__suggests_a_command(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fti", "capture", "--epochs", "3"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.rstrip().endswith("Did you mean `morgs-mi fit`?")


def test_main__suggests_nothing_for_other_mistakes(capsys) -> None:
    with pytest.raises(SystemExit):
        cli.main(["fit", "capture", "out", "--epochs", "many"])
    assert "Did you mean" not in capsys.readouterr().err


def test_fit__lists_all_presets_in_its_help(capsys) -> None:
    with pytest.raises(SystemExit):
        cli.main(["fit", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    start = text.index("--preset NAME")
    shown = text[start : text.index("--config", start)]
    assert [name for name in get_args(PresetName) if name not in shown.replace(",", " ").split()] == []
