"""`morgs-mi render`: a stream as seen by one camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from morgs_mi.cli.console import print_result, progress

__all__ = ["Render"]


@dataclass(frozen=True)
class Render:
    """Render a stream for one camera into a video, EXR files or PNG files."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    camera: str
    """Camera of the stream, by index or name."""
    channels: tuple[Literal["color", "motion", "confidence", "depth", "alpha"], ...] | None = None
    """Channels to render; by default colour, and for EXR files all that the stream holds."""
    output: Path | None = None
    """FILE.mp4, a folder for PNG files whose name ends in png, or another new folder for multichannel EXR files (R, G,
    B in linear light, motion.X, motion.Y in pixels, confidence.Y, depth.Y); by default OUT/CAMERA.mp4."""

    def run(self) -> None:
        from morgs_mi.export.frames import write_frames
        from morgs_mi.playback.player import find_camera, num_frames, open_stream

        stream = open_stream(self.out)
        camera = find_camera(stream, self.camera)
        output = self.output or stream.path.with_name(f"{camera.name}.mp4")
        total = num_frames(stream)
        with progress() as report:
            write_frames(
                stream, camera, output, self.channels, lambda done: report("Rendering", done, max(total, done))
            )
        print_result(f"{output}: camera {camera.name}, {camera.width}x{camera.height}.")
