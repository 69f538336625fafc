"""`morgs-mi render`: a stream as seen by one camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.capture.outputs import check_output
from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import ChannelName, optional

__all__ = ["Render"]

_CHANNELS = (
    "Channels to render, side by side: color, motion, confidence, depth, alpha. By default color, and for EXR files "
    "all that the stream stores."
)
_OUTPUT = (
    "FILE.mp4; a new folder whose name ends in png, for PNG files; or another new folder, for multichannel EXR files "
    "(R, G, B in linear light, motion.X and motion.Y in pixels, confidence.Y, depth.Y). By default OUT/CAMERA.mp4."
)


@dataclass(frozen=True)
class Render:
    """Render a stream for one camera into a video, EXR files or PNG files."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    camera: Annotated[str, arg(metavar="CAMERA")]
    """Camera of the stream, by index or name; `morgs-mi info` lists those of a capture."""
    channels: Annotated[tuple[ChannelName, ...] | None, DisallowNone, optional("NAME ...", text=_CHANNELS)] = None
    output: Annotated[Path | None, DisallowNone, optional("PATH", text=_OUTPUT)] = None

    def run(self) -> None:
        from morgs_mi.export.clips import frame_numbers
        from morgs_mi.export.frames import write_frames
        from morgs_mi.playback.player import find_camera, open_stream

        stream = open_stream(self.out)
        camera = find_camera(stream, self.camera)
        output = check_output(self.output or stream.path.with_name(f"{camera.name}.mp4"))
        total = len(frame_numbers(stream))
        with progress() as report:
            write_frames(stream, camera, output, self.channels, lambda done: report("Rendering", done, total))
        print_result(f"{output}: {total} frames of camera {camera.name}, {camera.width}x{camera.height}.")
