"""What the commands print: results on standard output, progress and complaints on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["ERR", "OUT", "Report", "progress", "say", "warn"]

# Rich would wrap paths and sentences at 80 columns where there is no terminal, and make a picture of `:100:`.
OUT = Console(soft_wrap=True, highlight=False, emoji=False)
ERR = Console(stderr=True, soft_wrap=True, highlight=False, emoji=False)
Report = Callable[[str, float, float], None]


def say(text: str) -> None:
    """Print a result."""
    OUT.print(text, markup=False)


def warn(text: str) -> None:
    """Print a complaint."""
    ERR.print(text, markup=False)


@contextmanager
def progress() -> Iterator[Report]:
    """Show a bar per stage; give a function to be called with (stage, done, total)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=ERR) as bars:

        def report(stage: str, done: float, total: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, count=0)
            bars.update(tasks[stage], completed=done, total=total, count=int(done))

        yield report
