"""Console output: results on standard output, progress and warnings on standard error."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

__all__ = ["ERR", "OUT", "Report", "print_result", "print_table", "print_warning", "progress", "with_option_names"]

# Rich would wrap paths and sentences at 80 columns without a terminal, and turn `:100:` into an emoji.
OUT = Console(soft_wrap=True, highlight=False, emoji=False)
ERR = Console(stderr=True, soft_wrap=True, highlight=False, emoji=False)
Report = Callable[[str, float, float], None]


def print_result(text: str) -> None:
    """Print to standard output."""
    OUT.print(text, markup=False)


def print_table(table: Table) -> None:
    """Print to standard output with complete columns, even where the terminal is narrower than the table."""
    needed = OUT.measure(table, options=OUT.options.update(max_width=1000)).maximum
    Console(width=max(OUT.width, needed), highlight=False, emoji=False).print(table)


def print_warning(text: str) -> None:
    """Print to standard error."""
    ERR.print(text, markup=False)


def with_option_names(sentence: str, names: Mapping[str, str], place: str = "") -> str:
    """Return an error message with command-line options in place of Python arguments.

    ``load_capture(): `downscale` must be ...`` becomes ``--downscale must be ...``. A message is changed only if it
    starts with a function or `place` and names one of the arguments, for in a file the same name is a key.

    Args:
        sentence: the message.
        names: options by argument name.
        place: a path from the command line that a message may start with; it stays.
    """
    function = re.match(r"[\w.]+\(\): ", sentence)
    start = function[0] if function else f"{place}: "
    if not (function or place) or not sentence.startswith(start):
        return sentence
    text = sentence[len(start) :]
    named = re.sub(r"`([\w.]+)`", lambda m: names.get(m[1], m[0]), text)
    if named == text:
        return sentence
    return named if function else start + named


@contextmanager
def progress() -> Iterator[Report]:
    """Show a progress bar per stage; the context is a function to call with (stage, done, total)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=ERR) as bars:

        def report(stage: str, done: float, total: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, count=0)
            bars.update(tasks[stage], completed=done, total=total, count=int(done))

        yield report
