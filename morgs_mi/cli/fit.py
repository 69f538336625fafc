"""`morgs-mi fit`: from a capture to a stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import Flag, GivenReading, GivenSettings, Reading, Settings
from morgs_mi.config import config_toml

__all__ = ["Fit"]


@dataclass(frozen=True)
class Fit:
    """Reconstruct a capture, frame after frame, into OUT/stream.morgs.

    All other settings are in a file, see --print-config and --config. It overrides the preset; options override both.
    """

    capture: Annotated[Positional[Path | None], arg(help_behavior_hint="")] = None
    """Folder of the capture."""
    out: Annotated[Positional[Path | None], arg(help_behavior_hint="")] = None
    """Folder for stream.morgs and report.json; an earlier stream is replaced unless resumed."""
    frames: Annotated[int | None, DisallowNone, arg(metavar="INT", help_behavior_hint="(default: all)")] = None
    """Number of frames from the start."""
    downscale: float = 1
    """Factor by which the images are averaged down."""
    test_view: Annotated[int | Literal["auto"] | None, arg(metavar="INT|None")] = "auto"
    """Index of the held-out camera; auto: the capture's own, or 0 of six or more."""
    reading: GivenReading = field(default_factory=Reading)
    settings: GivenSettings = field(default_factory=Settings)
    resume: Flag = False
    """Continue the stream in OUT, with the same capture and settings; with --reproducible to the same bytes."""
    print_config: Flag = False
    """Print all settings as TOML and exit."""

    arguments: ClassVar[Mapping[str, str]] = {"max_frames": "--frames"}

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.recorder import stream_capture

        config = self.settings.stream_config()
        if self.print_config:
            print_result(config_toml(config).rstrip())
            return
        if self.capture is None or self.out is None:
            raise ValueError("morgs-mi fit: expected the folders CAPTURE and OUT, got fewer; see morgs-mi fit --help.")
        self.settings.check_methods(config)
        capture = load_capture(self.capture, self.downscale, self.test_view, self.frames, self.reading.read_config())
        count = capture.num_frames
        with progress() as report:
            reports = stream_capture(
                capture,
                self.out,
                config,
                lambda frame, step, steps: report("Fitting frames", frame + step / steps, count),
                self.resume,
            )
        seconds = [row.seconds for row in reports[1:]]
        later = f", {sum(seconds) / len(seconds):.1f} s for each later one" if seconds else ""
        stream = self.out / "stream.morgs"
        print_result(
            f"{stream}: {len(reports)} frames, {stream.stat().st_size / 1e6:.1f} MB, "
            f"{reports[0].seconds:.1f} s for the first frame{later}."
        )
