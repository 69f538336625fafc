"""Progress bars of long calls, in notebooks and on terminals."""

from __future__ import annotations

import html
import sys
import time
from datetime import timedelta
from typing import Any

__all__ = ["ProgressBar"]

_PERIOD = 0.2  # seconds between two updates
_WIDTH = 30
_HTML = '<div>{title} <progress value="{done}" max="{total}" style="width:20em"></progress> {text}</div>'


class ProgressBar:
    """Progress bar, to be passed to a long call.

    In a notebook it is an element of the cell's output, on a terminal a line; otherwise nothing is shown.

    Args:
        title: what is done.
        total: number of steps, if the call does not report it.

    Example:
        >>> evaluate_stream("out/fit", progress=ProgressBar("Evaluating"))
        >>> stream_capture(capture, "out/fit", on_step=ProgressBar("Fitting", capture.num_frames).on_step)
    """

    def __init__(self, title: str, total: float | None = None) -> None:
        self._title, self._total = title, total
        self._begin, self._shown = time.monotonic(), -_PERIOD
        self._output: Any = None
        self._is_notebook = _is_notebook()

    def __call__(self, done: float, total: float | None = None) -> None:
        """Show that `done` steps of `total` are done."""
        total, now = total or self._total, time.monotonic() - self._begin
        if now - self._shown < _PERIOD and done != total:
            return
        self._shown = now
        text = f"{done:.0f}{'' if total is None else f'/{total:.0f}'}, {timedelta(seconds=round(now))}"
        if self._is_notebook:
            self._show_html(done, total, text)
        elif sys.stderr.isatty():
            filled = round(_WIDTH * done / total) if total else 0
            end = "\n" if done == total else ""
            sys.stderr.write(f"\r{self._title} {'━' * filled:{_WIDTH}} {text}{end}")
            sys.stderr.flush()

    def on_step(self, frame: int, step: int, steps: int) -> None:
        """Show that a fit has done a step of a frame; to be passed to `stream_capture`."""
        self(frame + step / steps)

    def _show_html(self, done: float, total: float | None, text: str) -> None:
        from IPython.display import HTML, display  # type: ignore[import-not-found]

        value = done if total else 0
        content = HTML(_HTML.format(title=html.escape(self._title), done=value, total=total or 1, text=text))
        if self._output is None:
            self._output = display(content, display_id=True)
        elif self._output is not None:
            self._output.update(content)


def _is_notebook() -> bool:
    """Return whether this is a cell of a notebook, and not a script or IPython on a terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return hasattr(shell, "kernel")
