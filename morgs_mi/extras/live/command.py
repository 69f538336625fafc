"""`morgs-mi live`: from cameras to a stream, while they record."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import field
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_next, print_result, print_warning, progress
from morgs_mi.cli.settings import (
    Flag,
    Settings,
    options,
    setting,
)
from morgs_mi.extras.live.fit_live import LiveFrame, fit_live
from morgs_mi.extras.live.live_config import LIVE_STREAM, LiveConfig
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.files import PROVISIONAL, STREAM

_PERIOD = 1.0  # least time between two lines about frames, s


@options
class LiveSettings(Settings):
    """Settings of a live fit, with its own defaults."""

    first_frame_seconds: Annotated[float | None, setting("first_frame_seconds", LIVE_STREAM)] = None
    """Time that the first frame may take on this machine."""
    epochs: Annotated[int | None, setting("epochs", LIVE_STREAM)] = None
    """Passes over the views for every later frame."""


@options
class Live:
    """Reconstruct what cameras see, while they see it, into OUT/stream.morgs; Ctrl-C ends it.

    Whenever a frame is fitted, the newest images follow, and those between are dropped.
    """

    out: Annotated[
        Positional[Path | None],
        arg(help_behavior_hint="(default: live-DATE-TIME)", metavar="[OUT]"),
    ] = None
    """Folder for stream.morgs, capture.json and report.json, and for the fitted images in its
    folder capture.
    """
    camera: Annotated[tuple[str, ...], arg(metavar="SOURCE ...")] = ()
    """Per camera its number, a URL or a video."""
    live: Annotated[LiveConfig, arg(name="")] = field(default_factory=LiveConfig)
    view: Flag = False
    """Show the stream in the viewer, which follows it."""
    browser: bool = True
    """Open the viewer in the browser of this machine."""
    settings: Annotated[LiveSettings, arg(name="")] = field(default_factory=LiveSettings)

    def run(self) -> None:
        out = self.out or Path(time.strftime("live-%Y%m%d-%H%M%S"))
        config = self.settings.stream_config(LIVE_STREAM)
        self.settings.check_methods(config)
        sources = [int(source) if source.isdecimal() else source for source in self.camera]
        with ExitStack() as viewer, progress() as report:
            lines = _Lines()
            is_shown = not self.view

            def show() -> None:
                nonlocal is_shown
                if not is_shown:
                    is_shown = True
                    viewer.callback(stop_viewer, start_viewer(out, self.browser))

            def on_frame(row: LiveFrame, _: FrameReport) -> None:
                lines.add(row)
                show()

            def on_stage(stage: str, done: float, total: float) -> None:
                report(stage, done, total)
                if (out / PROVISIONAL).exists():
                    show()

            rows = fit_live(sources, out, self.live, config, on_frame, on_stage)
        print_result(_summary(out, rows))
        print_next("view", out)


class _Lines:
    """Lines about frames on standard error, at most one per second; each counts what was dropped
    since the last.
    """

    def __init__(self) -> None:
        self._last = float("-inf")
        self._drops = 0

    def add(self, row: LiveFrame) -> None:
        self._drops += row.dropped
        if (time_now := time.monotonic()) - self._last < _PERIOD:
            return
        print_warning(
            f"Frame {row.frame}: {row.time:.1f} s after the first, latency {row.latency:.2f} s, "
            f"{quantity(self._drops, 'frame')} dropped, skew {1e3 * row.skew:.0f} ms."
        )
        self._last = time_now
        self._drops = 0


def _summary(out: Path, rows: Sequence[LiveFrame]) -> str:
    """Return a summary of a live fit in one sentence."""
    stream = out / STREAM
    drops = sum(row.dropped for row in rows)
    text = (
        f"{stream}: fitted {len(rows)} of {len(rows) + drops} frames ({drops} dropped) in "
        f"{rows[-1].time:.1f} s, {stream.stat().st_size / 1e6:.1f} MB, {rows[0].latency:.1f} s "
        "for the first one"
    )
    if len(rows) > 1:
        latency = np.mean([row.latency for row in rows[1:]])
        skew = max(row.skew for row in rows)
        text += f", mean latency of the others {latency:.2f} s, largest skew {1e3 * skew:.0f} ms"
    return f"{text}."


def start_viewer(out: Path, browser: bool) -> subprocess.Popen[bytes]:
    """Start the viewer in a process of its own: in one process it would wait for the renderings of
    the fit.
    """
    command = [
        sys.executable,
        "-P",  # no module of the current folder
        "-m",
        "morgs_mi",
        "view",
        str(out),
        "--follow",
        "--browser" if browser else "--no-browser",
        "--variant",
        mi.variant(),
    ]
    # Ctrl-C is for the fit, which ends the viewer.
    return subprocess.Popen(command, start_new_session=True)


def stop_viewer(process: subprocess.Popen[bytes]) -> None:
    """End the viewer and wait for its end."""
    process.kill()  # asked to end, it would report an interruption
    process.wait()
