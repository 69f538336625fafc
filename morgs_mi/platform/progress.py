"""Progress of long calls, and bars that show it in notebooks and on terminals."""

from __future__ import annotations

import html
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

Report = Callable[[str, float, float], None]
"""Function that is called with (stage, done, total)."""

StepReport = Callable[[int, int], None]
"""Function that is called with (done, total)."""

_PERIOD = 0.2  # seconds between two updates
_WIDTH = 30
_MEASURED = 0.03  # share of a stage after which its pace is known


def unreported(*_: object) -> None:
    """Report no progress."""


def duration(seconds: float) -> str:
    """Return a time in words, such as ``30 s`` or ``4 min``."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def time_left(seconds: float, done: float, total: float, base: float = 0.0) -> float | None:
    """Return the seconds that a stage still takes at its pace, None before 3 % of it.

    Args:
        seconds: since the stage began.
        done: how much is done.
        total: how much there is.
        base: what was done before it began, which is not part of the pace.
    """
    if done - base <= _MEASURED * (total - base):
        return None
    return seconds * (total - done) / (done - base)


def name_of(stage: str) -> str:
    """Return the name of a stage without what changes meanwhile, which follows a comma."""
    return stage.partition(", ")[0]


@dataclass(frozen=True)
class Progress:
    """Progress of a stage of a long call; to be called with (done, total)."""

    #: Function that is called with (stage, done, total); None: nothing is reported.
    report: Report | None = None
    stage: str = ""  #: Name of the stage.

    def __call__(self, done: float, total: float) -> None:
        """Report that `done` of `total` is done."""
        if self.report is not None:
            self.report(self.stage, done, total)

    def of(self, stage: str) -> Progress:
        """Return the progress of another stage."""
        return replace(self, stage=stage)

    def forecast(self, stage: str, text: str) -> Progress:
        """Return the progress of another stage, whose name ends with a text, such as ``, about
        42 s``, until its pace is known.
        """

        def report(_: str, done: float, total: float) -> None:
            self.of(stage + text if done <= _MEASURED * total else stage)(done, total)

        return Progress(report, stage)

    def part(self, done: float, total: float) -> Progress:
        """Return the progress of one of `total` equal parts of this stage, after `done` others."""
        return Progress(lambda _, inner, inner_total: self(done + inner / inner_total, total))


class ProgressBar:
    """Progress bar, to be passed to a long call.

    In a notebook it is an element of the cell's output, on a terminal a line; otherwise nothing is
    shown.

    Args:
        title: what is done.
        total: number of steps, if the call does not report it.

    Example:
        >>> evaluate_stream("out/fit", progress=ProgressBar("Evaluating"))
        >>> stream_capture(capture, "out/fit", progress=ProgressBar("Fitting").report)
    """

    def __init__(self, title: str, total: float | None = None) -> None:
        self._title = title
        self._total = total
        self._stage = ""
        self._begin = time.monotonic()
        self._shown = -math.inf
        self._first = math.inf
        self._output: Any = None

    def __call__(self, done: float, total: float | None = None) -> None:
        """Show that `done` steps of `total` are done."""
        total = total or self._total
        moment = time.monotonic()
        if moment - self._shown < _PERIOD and done != total:
            return
        self._shown = moment
        share = f"{done:.0f}" if total is None else f"{done:.0f}/{total:.0f}"
        seconds = moment - self._begin
        text = f"{share}, {duration(seconds)}"
        self._first = min(done, self._first)
        left = time_left(seconds, done, total or done, self._first)
        if left:
            text = f"{share}, about {duration(left)} left"
        name = f"{self._title}: {self._stage}" if self._stage else self._title
        if is_notebook():
            from IPython.display import HTML, display  # type: ignore[import-not-found]

            content = HTML(
                f'<div>{html.escape(name)} <progress value="{done if total else 0}" '
                f'max="{total or 1}" style="width:20em"></progress> {text}</div>'
            )
            if self._output is None:
                self._output = display(content, display_id=True)
            else:
                self._output.update(content)
        elif sys.stderr.isatty():
            bar = round(_WIDTH * done / total) * "━" if total else ""
            end = "\n" if done == total else ""
            sys.stderr.write(f"\r{name} {bar:{_WIDTH}} {text}{end}")
            sys.stderr.flush()

    def report(self, stage: str, done: float, total: float) -> None:
        """Show that `done` of `total` is done in a stage; for calls that report stages."""
        if name_of(stage) != name_of(self._stage):
            self._begin = time.monotonic()
            self._shown = -math.inf
            self._first = math.inf
        self._stage = stage
        self(done, total)


def is_notebook() -> bool:
    """Return whether this is a cell of a notebook, and not a script or IPython on a terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return hasattr(shell, "kernel")
