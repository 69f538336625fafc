"""`morgs-mi fit`: from a capture to a stream."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Positional

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cli.console import ERR, print_next, print_result, print_warning, progress
from morgs_mi.cli.settings import (
    Flag,
    GivenReading,
    GivenSettings,
    HeldOut,
    Reading,
    Settings,
    held_out,
    optional,
    options,
)
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.config import config_toml
from morgs_mi.platform.files import STREAM


@options
class Fit:
    """Reconstruct a capture, frame after frame, into OUT/stream.morgs.

    All other settings are in a file, see --print-config and --config.

    The file overrides the preset; options override both.
    """

    capture: Positional[Path | None] = None
    """Folder of the capture."""
    out: Positional[Path | None] = None
    """Folder for stream.morgs, capture.json and report.json; an earlier stream there is replaced
    without --resume.
    """
    frames: Annotated[int | None, optional("INT", "(default: all)")] = None
    """Number of frames to fit, from the first one."""
    downscale: float = 1
    """Factor by which the images are reduced; 2 halves width and height."""
    reading: GivenReading = field(default_factory=Reading)
    hold_out: HeldOut = ("auto",)
    """Held-out cameras, by indices or names; none: all are fitted; auto: the capture's, or camera 0
    of six or more.
    """
    settings: GivenSettings = field(default_factory=Settings)
    print_config: Flag = False
    """Print all settings as TOML and exit."""
    resume: Flag = False
    """Continue an interrupted fit in OUT; capture and settings must be the same."""

    groups: ClassVar[Mapping[str, Sequence[str]]] = {
        "input": ("frames", "downscale", "trim", "offset", "gaps", "exclude", "near"),
        "cameras": ("hold-out", "exposure", "refine-cameras"),
        "first frame": (
            "num-gaussians",
            "first-frame-steps",
            "first-frame-seconds",
            "sh-degree",
        ),
        "later frames": ("epochs", "flow", "masks"),
        "output": ("quality", "target-size", "resume"),
    }

    def run(self) -> None:
        config = self.settings.stream_config()
        if self.print_config:
            print_result(config_toml(config).rstrip())
            return
        if self.capture is None or self.out is None:
            raise ValueError(
                "morgs-mi fit: expected two folders, CAPTURE with a video or a folder of images "
                f"for each camera, and OUT for the result, got {self.capture or 'none'}; give both "
                "before options with several values, such as --hold-out. `morgs-mi demo OUT` makes "
                "a capture and fits it."
            )
        self.settings.check_methods(config)
        views = held_out(self.hold_out)
        reading = self.reading.read_config()
        capture = load_capture(self.capture, self.downscale, views, self.frames, reading)
        reports = self.fit(capture, self.out, config)
        _print_summary(self.out / STREAM, reports)
        print_next("view", self.out)

    def fit(self, capture: Capture, out: Path, config: StreamConfig) -> list[FrameReport]:
        """Fit a capture into a folder, and return the reports of the frames in its stream."""
        from morgs_mi.runs.fit_capture import stream_capture

        stream = out / STREAM
        command = shlex.join(["morgs-mi", "view", str(out)])

        @cache
        def announce() -> None:
            if ERR.is_terminal:
                print_warning(f"A first picture is ready: {command}")

        with progress() as report, _noting_frames(stream, capture.num_frames, self.resume):
            return stream_capture(capture, out, config, self.resume, report, lambda _: announce())


def _print_summary(stream: Path, reports: Sequence[FrameReport]) -> None:
    """Print the size of a stream and the time that its frames took."""
    first = reports[0]
    seconds = [row.seconds for row in reports[1:]]
    later = f", {sum(seconds) / len(seconds):.1f} s for each later one" if seconds else ""
    print_result(
        f"{stream}: {quantity(len(reports), 'frame')}, {stream.stat().st_size / 1e6:.1f} MB, "
        f"{first.seconds:.1f} s for the first one ({first.num_gaussians} Gaussians, {first.steps} "
        f"steps){later}."
    )
    for sentence in first_frame_sentences(first.validation):
        print_result(sentence)
    if problems := [row for row in reports if row.status != "ok"]:
        row = problems[0]
        print_result(
            f"Frames with a problem (status in report.json): {len(problems)} of {len(reports)}; "
            f"frame {row.frame}: {row.status.rstrip('.')}."
        )


def first_frame_sentences(validation: Mapping[str, Any]) -> Iterator[str]:
    """Yield the sentences about the views in the report of the first frame."""
    refinement = validation.get("refinement", {})
    exposure = validation.get("exposure", {})
    draft = validation.get("draft", {})
    for part in (refinement, exposure, validation, draft):
        if "sentence" in part:
            yield part["sentence"]


@contextmanager
def _noting_frames(stream: Path, count: int, resume: bool) -> Iterator[None]:
    """Add the frames that the stream holds to an interruption or a failed write, unless it is an
    earlier fit's.
    """
    from morgs_mi.codec.reader import StreamReader

    begin = time.time()
    try:
        yield
    except (KeyboardInterrupt, OSError) as error:
        with suppress(OSError, ValueError):
            if resume or stream.stat().st_mtime >= begin:
                frames = quantity(len(StreamReader(stream).frame_numbers()), "frame")
                error.add_note(f"{stream} holds {frames} of {count}; continue with `--resume`.")
        raise
