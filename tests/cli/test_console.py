"""Console output: progress and tables without a terminal, and error messages in one line."""

import io
import logging
import time
import tomllib
from contextlib import suppress

import pytest
from rich.console import Console
from rich.table import Table

from morgs_mi.cli import console
from morgs_mi.cli.console import (
    LogHandler,
    print_result,
    print_table,
    print_warning,
    printable,
    progress,
    sentence_of,
)


def test_progress__prints_a_line_every_30_seconds_without_a_terminal(capsys, monkeypatch):
    clock = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: clock)
    with progress() as report:
        for done in range(13):
            report("Fitting frames", done, 12)
            clock += 10.0
        report("Drawing", 0, 2)
    assert capsys.readouterr().err.splitlines() == [
        "Fitting frames: 3/12, 30 s elapsed, about 2 min left.",
        "Fitting frames: 6/12, 60 s elapsed, about 60 s left.",
        "Fitting frames: 9/12, 2 min elapsed, about 30 s left.",
        "Fitting frames: 12/12, 2 min elapsed, about 0 s left.",
    ]


def test_progress__estimates_the_time_left_from_the_pace_of_the_stage_alone(capsys, monkeypatch):
    clock = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: clock)
    with progress() as report:
        report("First frame", 0, 1)
        clock += 3600.0
        for done in (6.5, 7, 7.5, 8):  # a resumed fit: six frames were there before
            report("Later frames", done, 10)
            clock += 20.0
    assert capsys.readouterr().err.splitlines() == [
        "Later frames: 6/10, 0 s elapsed.",
        "Later frames: 7/10, 40 s elapsed, about 2 min left.",
    ]


def test_print_table__is_as_wide_as_its_content_without_a_terminal(capsys):
    table = Table("camera", "x" * 60)
    table.add_row("a_camera_with_a_name_of_50_characters_or_a_few_more", "y" * 70)
    print_table(table)
    text = capsys.readouterr().out
    assert all(
        word in text
        for word in ("a_camera_with_a_name_of_50_characters_or_a_few_more", "x" * 60, "y" * 70)
    )
    assert len(text.splitlines()) == 5


HOSTILE = "a\x1b[2J\x9b\x7f\udcff\u202e[red]b"


def test_console__prints_control_characters_escaped(capsys):
    table = Table(HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE)
    print_result(HOSTILE + "\nb")
    print_table(table)
    print_warning(HOSTILE + "\nb")
    printed = capsys.readouterr()
    escaped = r"a\u001b[2J\u009b\u007f\udcff\u202e[red]b"
    assert printed.out.count(escaped) == 4
    assert printed.out.startswith(f"{escaped}\nb\n")
    assert printed.err == f"{escaped} b\n"


def test_printable__changes_no_text_and_no_toml():
    assert printable("é ✓ 日本\n") == "é ✓ 日本\n"
    assert tomllib.loads(printable('a = "\x9b\U000e0001"')) == {"a": "\x9b\U000e0001"}


def test_LogHandler__prints_one_line_with_the_level(capsys):
    LogHandler().emit(
        logging.LogRecord("name", logging.WARNING, "", 0, "%s: [left out]", ("cam1" * 40,), None)
    )
    assert capsys.readouterr().err == f"Warning: {'cam1' * 40}: [left out]\n"


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            FileNotFoundError(2, "No such file or directory", "a/b"),
            "a/b: No such file or directory.",
        ),
        (OSError("write_png(): cannot write a.png: full."), "cannot write a.png: full."),
        (
            FileExistsError("f(): out is not empty; set `overwrite`."),
            "out is not empty; set `overwrite`.",
        ),
        (ValueError("A.f(): `b` must\nbe 1."), "`b` must be 1."),
        (ValueError("clip (1): `b` must be 1."), "clip (1): `b` must be 1."),
        (MemoryError(), "Out of memory; process smaller images, or fewer frames or Gaussians."),
        (
            AttributeError("no a."),
            "Unexpected AttributeError: no a; run the command with --debug for the traceback.",
        ),
    ],
)
def test_sentence_of__has_no_number_and_no_function(error, sentence):
    assert sentence_of(error) == sentence


def test_progress__ends_a_stage_where_the_next_one_begins(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(console, "ERR", Console(file=screen, force_terminal=True, width=100))
    with suppress(KeyboardInterrupt), progress() as report:
        report("Balancing cameras", 1, 7)
        report("First frame, about 42 s", 0, 100)
        report("First frame", 50, 100)
        raise KeyboardInterrupt
    balancing, first_frame = screen.getvalue().split("\n")[-3:-1]
    assert "Balancing cameras" in balancing
    assert "7/7" in balancing
    assert "First frame " in first_frame
    assert "50/100" in first_frame
