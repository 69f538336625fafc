"""What the exports of `morgs-mi export` have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from tyro.conf import Positional

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import optional
from morgs_mi.core.progress import Report
from morgs_mi.playback.export.formats import Format, destination

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource

FRAMES = optional(
    "FRAMES", text="Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."
)


def relative_to(stream: FrameSource) -> str:
    """Return the origin of the centres in files of float32 in words, empty if it is 0."""
    from morgs_mi.playback.stream_header import stream_origin

    x, y, z = stream_origin(stream)
    return f", relative to the origin ({x:.10g}, {y:.10g}, {z:.10g})" if x or y or z else ""


@dataclass(frozen=True)
class ExportKind:
    """A kind of export: options, with `formats` and the method `write` of their writer."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""

    formats: ClassVar[tuple[Format, ...]]
    drawn: ClassVar[bool] = False
    arguments: ClassVar[Mapping[str, str]] = {"span": "--frames", "least": "--least-seconds"}

    def run(self, stream: FrameSource) -> None:
        options: Mapping[str, Any] = vars(self)
        stem = Path(options.get("path", "")).stem
        output, chosen = destination(stream.path, options["output"], self.formats, stem)
        with progress() as report:
            summary = self.write(stream, output, chosen, report)
        print_result(f"{output}: {summary}.")

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        """Write a stream in a format, and return a summary."""
        raise NotImplementedError
