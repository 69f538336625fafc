"""Console output: results on standard output, progress and warnings on standard error."""

from __future__ import annotations

import logging
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from morgs_mi.platform.progress import Report, duration, name_of, time_left

STDOUT = "standard output"
"""Name of standard output in errors."""
_PERIOD = 30.0  # seconds between two lines of progress without a terminal
_PACE = 3600.0  # seconds from whose steps a bar estimates the time left: a step may take minutes


def printable(text: str) -> str:
    r"""Return a text with its control characters as ``\u001b``: names in a file may hold escape
    sequences.
    """
    return "".join(c if c == "\n" or c.isprintable() else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    """Return a character as TOML has it."""
    return f"\\u{ord(character):04x}" if ord(character) < 0x10000 else f"\\U{ord(character):08x}"


class _Console(Console):
    """Console that prints texts and the cells of tables as they are, but no control characters."""

    def __init__(self, **options: Any) -> None:
        # Rich would wrap paths and sentences at 80 columns without a terminal, and turn `:100:`
        # into an emoji.
        super().__init__(markup=False, highlight=False, emoji=False, **options)
        self.soft_wrap = not self.is_terminal

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text as Rich prints it."""
        return super().render_str(printable(text), **{**options, "markup": False})


OUT = _Console()
ERR = _Console(stderr=True)

# Errors that the user can correct; any other is a fault of the package, or of a library.
_EXPECTED = (ValueError, OSError, MemoryError, ArithmeticError)


@contextmanager
def naming_output() -> Iterator[None]:
    """Name standard output in an error of the system."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, STDOUT) from error


def print_result(text: str, style: str = "") -> None:
    """Print to standard output; on a terminal, lines are wrapped between words, in a style of Rich.

    Raises:
        OSError: it is full or closed; the error names it.
    """
    text = printable(text)
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(
            textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False)
            for line in text.split("\n")
        )
    with naming_output():
        with OUT.capture() as captured:  # Rich would end the process where a pipe is closed
            OUT.print(text, style=style, soft_wrap=True)
        print(captured.get(), end="")


def print_next(*words: object) -> None:
    """Print the command that is likely to follow."""
    print_result(f"Next: morgs-mi {shlex.join(map(str, words))}")


def print_table(table: Table, dispensable: Sequence[str] = ()) -> None:
    """Print to standard output, on a narrow terminal without the first of some columns."""
    wide = _Console(width=10_000)
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns
        for header in dispensable:
            if Measurement.get(wide, wide.options, table).maximum > width:
                table.columns = [column for column in table.columns if column.header != header]
    with naming_output():
        (_Console() if sys.stdout.isatty() else wide).print(table)


def print_warning(text: str) -> None:
    """Print one line to standard error."""
    ERR.print(text.replace("\n", " "))


class LogHandler(logging.Handler):
    """Handler that prints log messages to standard error, one line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message after its level."""
        print_warning(f"{record.levelname.capitalize()}: {record.getMessage()}")


def sentence_of(error: BaseException) -> str:
    """Return the message of an error in one line, without the number of a system error and the
    Python function that a user did not call.
    """
    message = str(error)
    if isinstance(error, OSError) and error.errno is not None and error.strerror:
        file = f"{error.filename}: " if error.filename else ""
        message = f"{file}{error.strerror.rstrip('.')}."
    if isinstance(error, MemoryError) and not message:
        message = "Out of memory; process smaller images, or fewer frames or Gaussians."
    text = " ".join(message.split())
    function, _, sentence = text.partition("(): ")
    if sentence and function.replace(".", "_").isidentifier():
        text = sentence
    if not isinstance(error, _EXPECTED):
        return (
            f"Unexpected {type(error).__name__}: {text.rstrip('.')}; run the command with --debug "
            "for the traceback."
        )
    return text or f"{type(error).__name__}."


@contextmanager
def progress() -> Iterator[Report]:
    """Show a progress bar per stage, which ends where the next one begins, or without a terminal a
    line every 30 s.

    The context is a function to call with (stage, done, total).
    """
    if not ERR.is_terminal:
        yield _line_report()
        return
    columns = (
        SpinnerColumn(finished_text=" "),
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=ERR, speed_estimate_period=_PACE) as bars:

        def end_stages() -> None:
            for task in tasks.values():  # a stage may end before its last step
                bars.update(task, completed=bars.tasks[task].total)

        def report(stage: str, done: float, total: float) -> None:
            name = name_of(stage)
            if name not in tasks:
                end_stages()
                tasks[name] = bars.add_task(stage, total=total, completed=int(done))
            bars.update(tasks[name], description=stage, completed=done, total=total)

        yield report
        end_stages()


def _line_report() -> Report:
    """Return a function that prints the progress of a stage if no line was printed for 30 s."""
    begin: dict[str, tuple[float, float]] = {}
    last = time.monotonic()

    def report(stage: str, done: float, total: float) -> None:
        nonlocal last
        moment = time.monotonic()
        start, base = begin.setdefault(name_of(stage), (moment, done))
        if moment - last < _PERIOD:
            return
        last = moment
        seconds = moment - start
        line = f"{stage}: {int(done)}/{total:.0f}, {duration(seconds)} elapsed"
        left = time_left(seconds, done, total, base)
        if left is not None:
            line += f", about {duration(left)} left"
        print_warning(f"{line}.")

    return report
