"""`morgs-mi --version`, completion of a shell, and commands and presets that are listed."""

import os
import re
import subprocess
import sys
from importlib.metadata import version
from typing import get_args

import pytest

from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import COMMANDS, OLD_OPTIONS, main
from morgs_mi.loop.stream_config import PresetName
from tests.cli.commands import assert_one_sentence


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


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["fit", "a", "b", "--test-view", "0"], ("--test-view is now --hold-out.",)),
        (["info", "a", "--without=cam0"], ("--without is now --exclude.",)),
        (["fit", "a", "b", "--segments", "2"], ("--segments is now --chunks.",)),
        (
            ["fit", "a", "b", "--reproducible"],
            ("fits without a limit of the clock are",),
        ),
        (["fit", "a", "b", "--key_views", "4"], ("`key_views` in `[motion]`",)),
    ],
)
def test_main__names_what_replaces_an_option_that_went(words, parts, run):
    status, output, error = run(*words)
    assert (status, output) == (2, "")
    assert_one_sentence(error, *parts)


@pytest.mark.parametrize(
    ("words", "names"), [(["rendr", "a.ply"], COMMANDS), (["export", "gltff", "a"], EXPORTS)]
)
def test_main__lists_the_commands_where_one_is_unknown(words, names, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(words)
    captured = capsys.readouterr()
    text = " ".join((captured.out + captured.err).replace("│", " ").split())
    assert words[-2] in text
    assert f"Available subcommands: {', '.join(names)}" in text


def test_old_options__are_options_of_no_command(capsys):
    for words in (*([name] for name in COMMANDS), *(["export", name] for name in EXPORTS)):
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        options = re.findall(r"^  (?:-\w, )?(--[\w-]+)", capsys.readouterr().out, re.MULTILINE)
        assert "--debug" in options
        assert not {*options} & {*OLD_OPTIONS}


def test_fit__lists_all_presets_in_its_help(capsys):
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    shown = text.partition("--preset NAME")[2].partition("--config")[0].replace(",", " ").split()
    assert set(get_args(PresetName)) <= set(shown)
