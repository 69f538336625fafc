"""`morgs-mi render`: a stream, or a file of Gaussians, as seen by one camera or along a path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import ChannelName, DisplayExposure, Flag, optional, options
from morgs_mi.cli.streams import (
    Background,
    DropInvalid,
    on_background,
    opened,
    print_between,
    print_view,
    rendering,
    shown_exposure,
)
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.camera import Camera
from morgs_mi.core.types import Arrays
from morgs_mi.platform.checks import quantity
from morgs_mi.playback.export.formats import IMAGES, SHEET, destination

_THUMBNAIL = 320  # pixels
RenderedImages = Iterator[tuple[int, Arrays]]
"""Index and channels of each image."""


@options
class Render:
    """Render a stream or a file of Gaussians into a video, EXR files or PNG files, for one camera
    or along a path.
    """

    source: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians: .ply, .compressed.ply or .splat."""
    output: Annotated[
        Positional[Path | None],
        arg(metavar="[FILE_OR_FOLDER]"),
    ] = None
    """FILE.mp4 (H.264) or FILE.webm (VP9); a new folder whose name ends in png, for PNG files;
    another new folder, for multichannel EXR files (R, G, B in linear light, motion.X and motion.Y
    in pixels, confidence.Y, depth.Y); FILE.png or FILE.exr for one image. By default CAMERA.mp4 or
    PATH.mp4, such as orbit.mp4, beside the stream; of a file of Gaussians, FILE-orbit.mp4 beside
    it.
    """
    camera: Annotated[str | None, optional("CAMERA")] = None
    """Camera of the stream, by index or name; `morgs-mi info` lists the cameras of a capture. A
    file of Gaussians has front, front-right, right, back-right, back, back-left, left and
    front-left. By default, a single image is seen by the first
    camera; for a file, by the one with most detail in view. all: thumbnails of the first frame in
    colour, with the names of the cameras, in FILE.png, by default all.png beside the stream.
    """
    path: Annotated[str | None, optional("PATH")] = None
    """Camera path, instead of a camera: orbit (around the scene, the default), between (through
    the cameras), or a JSON file (docs/exports.md). `morgs-mi export video` has more options.
    """
    degrees: float | None = None
    """Angle of an orbit, 1 to 360; by default the extent of the rig, and 60 for a file of
    Gaussians.
    """
    width: int | None = None
    """Width of the images; by default that of the camera."""
    channels: Annotated[tuple[ChannelName, ...] | None, optional("NAME ...")] = None
    """Channels to render, side by side: color, motion, confidence, depth, alpha. By default color,
    and for EXR files all that the stream stores.
    """
    background: Background = None
    """Colour behind the Gaussians: black, grey, white, #rrggbb, or transparent, for PNG files with
    straight alpha in sRGB; by default the fit's, which is usually black.
    """
    display_exposure: DisplayExposure = None
    drop_invalid: DropInvalid = False
    skip_damaged: Flag = False
    """Skip damaged frames of a stream, and those after them up to the next intact keyframe."""

    def run(self) -> None:
        from morgs_mi.playback.export.frames import write_images
        from morgs_mi.playback.stream_header import find_camera

        if self.camera is not None and self.path is not None:
            raise ValueError(
                f"expected --camera or --path, got both, {self.camera} and {self.path}; leave out "
                "one."
            )
        stream = opened(self.source, self.drop_invalid, skip_damaged=self.skip_damaged)
        if self.camera == "all":
            self._write_thumbnails(stream)
            return
        view = find_camera(stream, 0 if self.camera is None else self.camera)
        view = view if self.width is None else view.with_width(self.width)
        stem = Path(self.path or "orbit").stem if self.camera is None else view.name
        output, chosen = destination(stream.path, self.output, IMAGES, stem)
        single = chosen.folder and chosen.is_file(output)
        channels = shown = self.channels
        is_transparent = self.background == "transparent"
        if is_transparent:
            if chosen.name != "png" or shown not in (None, ("color",)):
                raise ValueError(
                    "--background transparent is for the colour in PNG files, got another output."
                )
            shown = ("color", "alpha")
        if chosen.name != "exr":
            shown = shown or ("color",)
            channels = tuple(dict.fromkeys((*shown, "color")))  # motion is over the grey colour
        on_background(stream, "black" if is_transparent else self.background)
        images, count = self.images(stream, view, channels, single)
        if single and count > 1:
            raise ValueError(
                f"{output}: expected one image for one file, got {count}; name a folder."
            )
        with progress() as report:
            write_images(
                images,
                stream.fps,
                output,
                rendering(report, count),
                shown_exposure(stream, self.display_exposure),
                is_transparent,
                shown,
            )
        print_result(f"{output}: {quantity(count, 'image')}.")
        if self.path is not None:
            print_between(stream)
        print_view(stream, self.camera or self.path, " or all")

    def images(
        self, stream: FrameSource, view: Camera, channels: Sequence[str] | None, single: bool
    ) -> tuple[RenderedImages, int]:
        """Return the rendered images, and their number.

        Args:
            stream: what is rendered.
            view: of the camera, by default the first.
            channels: as of `render_stream`.
            single: whether one image is asked for.
        """
        from morgs_mi.playback.export.clips import flight, frame_numbers, named_path, num_images
        from morgs_mi.playback.player import render_stream

        if self.camera is not None or (self.path is None and single):
            return render_stream(stream, view, channels), len(frame_numbers(stream))
        path = named_path(stream, self.path or "orbit", self.degrees)
        path = path if self.width is None else path.with_width(self.width)
        return flight(stream, path, channels), num_images(stream, path)

    def _write_thumbnails(self, stream: FrameSource) -> None:
        """Write the first frame as all cameras see it."""
        from morgs_mi.playback.player import camera_sheet
        from morgs_mi.playback.visualise import write_png

        output, _ = destination(stream.path, self.output, SHEET, "all")
        on_background(stream, self.background)
        write_png(output, camera_sheet(stream, self.width or _THUMBNAIL))
        print_result(f"{output}: {quantity(len(stream.cameras), 'camera')}.")
