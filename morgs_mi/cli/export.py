"""`morgs-mi export`: a stream in the formats of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.opening import DropInvalid, opened
from morgs_mi.cli.settings import ChannelName, DisplayExposure, Flag, one_of, optional, place
from morgs_mi.cli.suggestion import one_command
from morgs_mi.core.documentation import page
from morgs_mi.core.progress import Report
from morgs_mi.playback.export.formats import GLTF, PLY, TRACKS, USD, VIDEO, WEB, Format, destination

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource

__all__ = ["EXPORTS", "Export"]

_PATH = (
    f"Camera path: between (through the rig's cameras), orbit (around the scene), or a JSON file ({page('exports')})."
)
_FRAMES = optional("FRAMES", text="Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default.")


@dataclass(frozen=True)
class _Kind:
    """A kind of export: options, with `formats` and the method `write` of their writer."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""

    formats: ClassVar[tuple[Format, ...]]
    drawn: ClassVar[bool] = False
    arguments: ClassVar[Mapping[str, str]] = {"span": "--frames", "least": "--least-seconds"}

    def run(self, stream: FrameSource) -> None:
        given: Mapping[str, Any] = vars(self)
        stem = Path(given.get("path", "")).stem
        output, chosen = destination(stream.path, given["output"], self.formats, given.get("format"), stem)
        with progress() as report:
            summary = self.write(stream, output, chosen, report)
        print_result(f"{output}: {summary}.")

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        """Write a stream in a format, and return a summary."""
        raise NotImplementedError


@dataclass(frozen=True)
class Ply(_Kind):
    """Write a PLY file per frame, in the layout of 3D Gaussian Splatting or compressed, in the capture's axes."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FOLDER")] = None
    """New folder for 0000.ply, ..., or FILE.ply for one frame; by default OUT/ply or OUT/compressed-ply."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(tuple(f.name for f in PLY))] = None
    """Format: ply, or compressed.ply, PlayCanvas' layout, whose sequence SuperSplat plays. By default by the name."""
    frames: Annotated[str | None, DisallowNone, _FRAMES] = None

    formats = PLY

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.codec.frame_source import play
        from morgs_mi.io.compressed_ply import write_compressed_ply
        from morgs_mi.io.ply import write_ply
        from morgs_mi.playback.export.clips import select_frames, write_each
        from morgs_mi.playback.export.order import by_place

        clip, write = (by_place, write_compressed_ply) if chosen.name == "compressed.ply" else (play, write_ply)
        frames = select_frames(stream, self.frames)
        write_each(clip(stream), output, chosen.ending, write, frames, partial(report, "Writing"))
        return f"{len(frames)} PLY {'file' if len(frames) == 1 else 'files'}"


@dataclass(frozen=True)
class Gltf(_Kind):
    """Write a .glb file per frame: glTF 2.0 with KHR_gaussian_splatting, rotated to y up."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FOLDER")] = None
    """New folder for 0000.glb, ..., or FILE.glb for one frame; by default OUT/gltf."""
    frames: Annotated[str | None, DisallowNone, _FRAMES] = None

    formats = GLTF

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.codec.frame_source import play
        from morgs_mi.playback.export.axes import gltf_axes
        from morgs_mi.playback.export.clips import select_frames, write_each
        from morgs_mi.playback.export.gltf_export import write_gltf

        frames = select_frames(stream, self.frames)
        write = partial(write_gltf, axes=gltf_axes(stream.cameras))
        write_each(play(stream), output, chosen.ending, write, frames, partial(report, "Writing"))
        return f"{len(frames)} glTF {'file' if len(frames) == 1 else 'files'}"


@dataclass(frozen=True)
class Usd(_Kind):
    """Write an OpenUSD stage with a time sample per frame: ParticleField3DGaussianSplat, rotated to y up."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FILE")] = None
    """FILE.usd, .usdc (binary), .usda (text) or .usdz (package); by default OUT/stream.usdc."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(tuple(f.name for f in USD))] = None
    """Format: usdc, usd, usda or usdz; by default by the name."""
    frames: Annotated[str | None, DisallowNone, _FRAMES] = None
    half: Flag = False
    """Half precision of all attributes but the positions."""

    formats = USD

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import select_frames
        from morgs_mi.playback.export.usd import write_usd

        frames = select_frames(stream, self.frames)
        write_usd(stream, output, frames, self.half, partial(report, "Writing"))
        return f"{len(frames)} frames, {output.stat().st_size / 1e6:.2f} MB"


@dataclass(frozen=True)
class Flight(_Kind):
    """Render a stream along a moving camera into an mp4."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FILE.mp4")] = None
    """File for the video; by default OUT/PATH.mp4, e.g. OUT/orbit.mp4."""
    path: Annotated[str, arg(help=_PATH)] = "between"
    seconds: Annotated[float | None, DisallowNone, optional("FLOAT")] = None
    """Duration in seconds; by default that of the JSON file, or that of the clip, repeated to LEAST_SECONDS."""
    least_seconds: float = 5.0
    """Least duration without SECONDS; a shorter clip is played several times, as a whole. 0: once."""
    back_and_forth: Flag = False
    """Play every second time backwards, instead of restarting at the first frame."""
    degrees: Annotated[float | None, DisallowNone, optional("FLOAT")] = None
    """Angle of an orbit, 1 to 360; below 360 the camera swings to both sides. By default the extent of the rig."""
    freeze: Annotated[int | None, DisallowNone, optional("FRAME")] = None
    """Frame at which time stands still; by default the clip plays and repeats."""
    width: Annotated[int | None, DisallowNone, optional("INT")] = None
    """Width of the video; by default that of the first camera or the JSON file."""
    channels: tuple[ChannelName, ...] = ("color",)
    """Channels to render, side by side."""
    display_exposure: DisplayExposure = None

    formats = VIDEO
    drawn = True

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import flight, frame_numbers, named_path, num_images, repeated_frames
        from morgs_mi.playback.export.frames import write_images
        from morgs_mi.playback.player import stream_exposure

        frames = frame_numbers(stream)
        if self.freeze is not None and self.freeze not in frames:
            raise ValueError(f"--freeze must be in {frames[0]} to {frames[-1]}, got {self.freeze}.")
        path = named_path(stream, self.path, self.degrees, self.least_seconds)
        path = path if self.width is None else path.with_width(self.width)
        path = path if self.seconds is None else path.with_duration(self.seconds)
        count = num_images(stream, path)
        images = flight(stream, path, self.channels, repeated_frames(stream, self.freeze, self.back_and_forth))
        stops = stream_exposure(stream) if self.display_exposure is None else self.display_exposure
        write_images(images, stream.fps, output, lambda done: report("Rendering", done, count), None, stops)
        return f"{path.seconds:.1f} s, {path.keys[0].width}x{path.keys[0].height}"


@dataclass(frozen=True)
class Tracks(_Kind):
    """Write the track of every Gaussian as NumPy arrays: ids, frames, positions, confidence."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FILE.npz")] = None
    """File for the tracks; by default OUT/tracks.npz."""

    formats = TRACKS

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.tracks import extract_tracks, write_tracks

        total = len(frame_numbers(stream))
        tracks = extract_tracks(stream, lambda done: report("Following", done, total))
        write_tracks(output, tracks)
        T, N = tracks.positions.shape[:2]
        return f"{N} Gaussians through {T} frames"


@dataclass(frozen=True)
class Web(_Kind):
    """Write a web page that plays the stream without a server, or a folder for a server."""

    output: Annotated[Positional[Path | None], DisallowNone, place("FILE.html")] = None
    """FILE.html, or a new folder with the page, the stream and a module for three.js, for hosting; by default
    OUT/player.html or OUT/web."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(tuple(f.name for f in WEB))] = None
    """Format: html or folder; by default by the name."""
    title: Annotated[str | None, DisallowNone, optional("TEXT")] = None
    """Title of the page; by default the name of the stream's folder or file."""

    formats = WEB
    drawn = True

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.web import write_web_folder, write_web_page

        total = len(frame_numbers(stream))
        write = write_web_folder if chosen.folder else write_web_page
        size = write(stream, output, self.title, lambda done: report("Checking", done, total))
        return f"{total} {'frame' if total == 1 else 'frames'}, {size / 1e6:.2f} MB"


EXPORTS: Mapping[str, type[_Kind]] = {
    "ply": Ply,
    "gltf": Gltf,
    "usd": Usd,
    "video": Flight,
    "tracks": Tracks,
    "web": Web,
}


@dataclass(frozen=True)
class Export:
    """Export a stream for other programs."""

    kind: Annotated[Any, one_command(EXPORTS)]

    drop_invalid: DropInvalid = False

    commands: ClassVar[Mapping[str, type]] = EXPORTS

    def run(self) -> None:
        self.kind.run(opened(self.kind.out, self.drop_invalid, self.kind.drawn))
