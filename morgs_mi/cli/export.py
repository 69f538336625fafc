"""`morgs-mi export`: a stream in the formats of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from morgs_mi.cli.settings import (
    ChannelName,
    DisplayExposure,
    one_command,
    optional,
    options,
    place,
)
from morgs_mi.cli.streams import (
    FRAMES,
    Background,
    DropInvalid,
    ExportKind,
    PageCamera,
    on_background,
    opened,
    print_between,
    print_view,
    relative_to,
    rendering,
    shown_exposure,
    with_first_camera,
)
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.extras import extra, places
from morgs_mi.platform.progress import Report
from morgs_mi.playback.export.formats import PLY, VIDEO, WEB, Format


@options
class Ply(ExportKind):
    """Write a PLY file per frame, in the layout of 3D Gaussian Splatting or compressed, in the
    capture's axes.
    """

    output: Annotated[Positional[Path | None], place("FOLDER")] = None
    """New folder for 0000.ply, ..., or FILE.ply for one frame, by default ply beside the stream; a
    folder whose name ends in compressed-ply, or FILE.compressed.ply, for PlayCanvas' layout.
    """
    frames: Annotated[str | None, FRAMES] = None

    formats = PLY

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import select_frames, write_ply_files

        frames = select_frames(stream, self.frames)
        write_ply_files(stream, output, chosen, frames, partial(report, "Writing"))
        return quantity(len(frames), "PLY file") + relative_to(stream)


@options
class Flight(ExportKind):
    """Render a stream along a moving camera into a video."""

    output: Annotated[Positional[Path | None], place("FILE.mp4")] = None
    """File for the video, FILE.mp4 (H.264) or FILE.webm (VP9); by default PATH.mp4, such as
    between.mp4, beside the stream.
    """
    path: Annotated[str, arg(metavar="PATH")] = "between"
    """Camera path: between (through the rig's cameras), orbit (around the scene), or a JSON file
    (docs/exports.md).
    """
    seconds: float | None = None
    """Duration in seconds; by default the duration in the JSON file, or of the clip, which is
    repeated up to LEAST_SECONDS.
    """
    least_seconds: float = 5.0
    """Least duration without SECONDS; a shorter clip is played several times, as a whole. 0: once.
    """
    degrees: float | None = None
    """Angle of an orbit, 1 to 360; below 360 the camera swings to both sides. By default the extent
    of the rig.
    """
    freeze: Annotated[int | None, optional("FRAME")] = None
    """Frame at which time stands still; by default the clip plays and repeats."""
    width: int | None = None
    """Width of the video; by default that of the first camera or the JSON file."""
    channels: tuple[ChannelName, ...] = ("color",)
    """Channels to render, side by side."""
    background: Background = None
    display_exposure: DisplayExposure = None

    formats = VIDEO
    drawn = True

    def run(self, stream: FrameSource) -> None:
        super().run(stream)
        print_between(stream)

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import (
            flight,
            frame_numbers,
            named_path,
            num_images,
            repeated_frames,
        )
        from morgs_mi.playback.export.frames import write_images

        on_background(stream, self.background)
        numbers = frame_numbers(stream)
        if self.freeze is not None and self.freeze not in numbers:
            raise ValueError(
                f"--freeze must be in {numbers[0]} to {numbers[-1]}, got {self.freeze}."
            )
        path = named_path(stream, self.path, self.degrees, self.least_seconds)
        path = path if self.width is None else path.with_width(self.width)
        path = path if self.seconds is None else path.with_duration(self.seconds)
        count = num_images(stream, path)
        frames = repeated_frames(stream, self.freeze)
        write_images(
            flight(stream, path, self.channels, frames),
            stream.fps,
            output,
            rendering(report, count),
            shown_exposure(stream, self.display_exposure),
        )
        return f"{path.seconds:.1f} s, {path.keys[0].width}x{path.keys[0].height}"


@options
class Web(ExportKind):
    """Write a web page that plays the stream without a server, or a folder for a server."""

    output: Annotated[Positional[Path | None], place("FILE.html")] = None
    """FILE.html, or a new folder with the page, the stream and a module for three.js, for hosting;
    by default player.html or web beside the stream."""
    title: Annotated[str | None, optional("TEXT")] = None
    """Title of the page; by default the name of the stream's folder or file."""
    camera: PageCamera = None
    background: Background = None

    formats = WEB
    drawn = True

    def run(self, stream: FrameSource) -> None:
        super().run(stream)
        print_between(stream)
        print_view(stream, self.camera)

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.web import write_web_folder, write_web_page

        if self.background is not None and chosen.folder:
            raise ValueError(
                f"--background is for FILE.html, got the folder {output}, which has the stream "
                "unchanged."
            )
        on_background(stream, self.background)
        with_first_camera(stream, self.camera)
        total = len(frame_numbers(stream))
        write = write_web_folder if chosen.folder else write_web_page
        size = write(stream, output, self.title, lambda done: report("Checking", done, total))
        return f"{quantity(total, 'frame')}, {size / 1e6:.2f} MB"


# The class of each kind, in the order of the help.
EXPORTS: Mapping[str, type[ExportKind]] = {
    "ply": Ply,
    "video": Flight,
    "web": Web,
    **{name: extra("exports", name) for name in places("exports")},
}


@options
class Export:
    """Export a stream for other programs."""

    kind: Annotated[Any, one_command(EXPORTS)]

    drop_invalid: DropInvalid = False

    def run(self) -> None:
        self.kind.run(opened(self.kind.source, self.drop_invalid, self.kind.drawn))
