"""`morgs-mi render`: a stream, or a file of Gaussians, as seen by one camera or along a path."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import ChannelName, DisplayExposure, Flag, optional, options
from morgs_mi.cli.streams import Background, DropInvalid, on_background, opened, shown_exposure
from morgs_mi.core.checks import quantity
from morgs_mi.core.extras import extra
from morgs_mi.playback.export.formats import IMAGES, destination

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource
    from morgs_mi.core.camera import Camera

# Index and channels of each image.
_Images = Iterator[tuple[int, dict[str, Any]]]


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
    front-left, or the cameras of its training. By default, a single image is seen by the first
    camera; for a file, by the one with most detail in view.
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
    insert: Annotated[Path | None, optional("FILE")] = None
    """Mitsuba scene whose objects stand among the Gaussians: FILE.xml, or FILE.py with a function
    build(frame, time) that returns the entries of a scene. Without emitters it is lit by the
    stream.
    """
    at: Annotated[tuple[int, ...] | None, optional("FRAME ...", "(default: all)")] = None
    """Frames to render with an inserted scene."""
    samples: Annotated[int, arg(metavar="INT")] = 16
    """Samples per pixel of an inserted scene."""
    shadows: bool = True
    """Whether an inserted scene throws shadows on the stream."""

    light: Literal["probe", "traced"] = "probe"
    """Light of an inserted scene: an environment map at its middle, or rays traced through the
    Gaussians, for their shadows and reflections."""
    background: Background = None
    """Colour behind the Gaussians: black, grey, white, #rrggbb, or transparent, for PNG files with
    straight alpha in sRGB; by default the fit's, which is usually black.
    """
    display_exposure: DisplayExposure = None
    drop_invalid: DropInvalid = False
    skip_damaged: Flag = False
    """Skip damaged frames of a stream, and those after them up to the next intact keyframe."""

    def run(self) -> None:
        from morgs_mi.playback.export.clips import flight, frame_numbers, named_path, num_images
        from morgs_mi.playback.export.frames import write_images
        from morgs_mi.playback.player import render_stream
        from morgs_mi.playback.stream_header import find_camera

        if self.camera is not None and self.path is not None:
            raise ValueError(
                f"expected --camera or --path, got both, {self.camera} and {self.path}; leave out "
                "one."
            )
        if self.insert is None and self.at is not None:
            raise ValueError(
                "--at selects frames of an inserted scene, got no scene; add --insert FILE."
            )
        if self.insert is not None and self.camera is None:
            raise ValueError("--insert renders for one camera, got none; add --camera CAMERA.")
        stream = opened(self.source, self.drop_invalid, skip_damaged=self.skip_damaged)
        view = find_camera(stream, 0 if self.camera is None else self.camera)
        view = view if self.width is None else view.with_width(self.width)
        is_path = self.camera is None and self.insert is None
        stem = Path(self.path or "orbit").stem if is_path else view.name
        output, chosen = destination(stream.path, self.output, IMAGES, stem)
        single = chosen.folder and chosen.is_file(output)
        channels = self.channels or (None if chosen.name == "exr" else ("color",))
        is_transparent = self.background == "transparent"
        if is_transparent:
            if chosen.name != "png" or self.insert is not None or channels != ("color",):
                raise ValueError(
                    "--background transparent is for the colour in PNG files, got another output."
                )
            channels = ("color", "alpha")
        on_background(stream, "black" if is_transparent else self.background)
        if self.insert is not None:
            images, count = self._inserted(stream, view, chosen.name)
        elif self.camera is not None or (self.path is None and single):
            images = render_stream(stream, view, channels)
            count = len(frame_numbers(stream))
        else:
            path = named_path(stream, self.path or "orbit", self.degrees)
            path = path if self.width is None else path.with_width(self.width)
            images = flight(stream, path, channels)
            count = num_images(stream, path)
        if single and count > 1:
            raise ValueError(
                f"{output}: expected one image for one file, got {count}; name a folder."
            )
        with progress() as report:
            write_images(
                images,
                stream.fps,
                output,
                lambda done: report("Rendering", done, count),
                shown_exposure(stream, self.display_exposure),
                is_transparent,
            )
        print_result(f"{output}: {quantity(count, 'image')}.")

    def _inserted(self, stream: FrameSource, view: Camera, format: str) -> tuple[_Images, int]:
        """Return the rendered frames with the inserted scene, and their number."""
        from morgs_mi.playback.export.clips import frame_numbers

        assert self.insert is not None
        insert = extra("renderings", "insert")
        frames = frame_numbers(stream) if self.at is None else insert.selected(stream, self.at)
        channels = self.channels or ("color",)
        if not self.channels and format == "exr":
            channels = insert.inserted_channels(stream)
        config = insert.InsertConfig(self.samples, self.shadows, self.light)
        scene = insert.load_insert(self.insert)
        return insert.render_inserted(stream, view, scene, frames, channels, config), len(frames)
