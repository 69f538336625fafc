"""`morgs-mi render`: a stream as seen by one camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import ChannelName, one_of, optional
from morgs_mi.playback.export.formats import IMAGES, destination

__all__ = ["Render"]

_CHANNELS = (
    "Channels to render, side by side: color, motion, confidence, depth, alpha. By default color, and for EXR files "
    "all that the stream stores."
)
_OUTPUT = (
    "FILE.mp4; a new folder whose name ends in png, for PNG files; or another new folder, for multichannel EXR files "
    "(R, G, B in linear light, motion.X and motion.Y in pixels, confidence.Y, depth.Y). By default OUT/CAMERA.mp4, "
    "OUT/CAMERA-png or OUT/CAMERA-exr."
)
_INSERT = (
    "Mitsuba scene whose objects stand among the Gaussians: FILE.xml, or FILE.py with a function build(frame, time) "
    "that returns the entries of a scene. Without emitters it is lit by the stream."
)


@dataclass(frozen=True)
class Render:
    """Render a stream for one camera into a video, EXR files or PNG files."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    camera: Annotated[str, arg(metavar="CAMERA")]
    """Camera of the stream, by index or name; `morgs-mi info` lists those of a capture."""
    output: Annotated[
        Positional[Path | None], DisallowNone, arg(metavar="[FILE_OR_FOLDER]", help=_OUTPUT, help_behavior_hint="")
    ] = None
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(("mp4", "png", "exr"))] = None
    """Format: mp4, png or exr; by default by the name of the output."""
    channels: Annotated[tuple[ChannelName, ...] | None, DisallowNone, optional("NAME ...", text=_CHANNELS)] = None
    insert: Annotated[Path | None, DisallowNone, optional("FILE", text=_INSERT)] = None
    at: Annotated[tuple[int, ...] | None, DisallowNone, optional("FRAME ...", "(default: all)")] = None
    """Frames to render with an inserted scene."""
    samples: Annotated[int, arg(metavar="INT")] = 16
    """Samples per pixel of an inserted scene."""
    shadows: bool = True
    """Whether an inserted scene throws shadows on the stream."""

    light: Literal["probe", "traced"] = "probe"
    """Light of an inserted scene: an environment map at its middle, or rays traced through the Gaussians, for their
    shadows and reflections."""

    def run(self) -> None:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.frames import write_frames, write_images
        from morgs_mi.playback.export.insert import (
            InsertConfig,
            inserted_channels,
            load_insert,
            render_inserted,
            selected,
        )
        from morgs_mi.playback.player import find_camera
        from morgs_mi.playback.streams import open_stream

        stream = open_stream(self.out)
        camera = find_camera(stream, self.camera)
        output, chosen = destination(stream.path, self.output, IMAGES, self.format, camera.name)
        if self.insert is None and self.at is not None:
            raise ValueError("--at selects frames of an inserted scene, got no scene; add --insert FILE.")
        frames = frame_numbers(stream) if self.at is None else selected(stream, self.at)
        with progress() as report:

            def done(count: int) -> None:
                report("Rendering", count, len(frames))

            if self.insert is None:
                write_frames(stream, camera, output, self.channels, done, chosen.name)
            else:
                layers = inserted_channels(stream) if chosen.name == "exr" else ("color",)
                channels, build = self.channels or layers, load_insert(self.insert)
                config = InsertConfig(self.samples, self.shadows, self.light)
                images = render_inserted(stream, camera, build, frames, channels, config)
                write_images(images, stream.fps, output, done, chosen.name)
        print_result(f"{output}: {len(frames)} frames of camera {camera.name}, {camera.width}x{camera.height}.")
