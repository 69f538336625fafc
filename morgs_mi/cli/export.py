"""`morgs-mi export`: a stream in the formats of other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.opening import DropInvalid, opened
from morgs_mi.cli.settings import ChannelName, DisplayExposure, Flag, one_of, optional, place
from morgs_mi.core.documentation import page
from morgs_mi.playback.export.formats import GLTF, PLY, TRACKS, USD, VIDEO, WEB, Format, destination

if TYPE_CHECKING:
    from morgs_mi.playback.streams import PlayableStream

__all__ = ["Export"]

_PATH = (
    f"Camera path: between (through the rig's cameras), orbit (around the scene), or a JSON file ({page('exports')})."
)


def _names(formats: Sequence[Format]) -> tuple[str, ...]:
    return tuple(chosen.name for chosen in formats)


@dataclass(frozen=True)
class Ply:
    """Write a PLY file per frame, in the layout of 3D Gaussian Splatting or compressed, in the capture's axes."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
    output: Annotated[Positional[Path | None], DisallowNone, place("FOLDER")] = None
    """New folder for 0000.ply, ..., or FILE.ply for one frame; by default OUT/ply or OUT/compressed-ply."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(_names(PLY))] = None
    """Format: ply, or compressed.ply, PlayCanvas' layout, whose sequence SuperSplat plays. By default by the name."""
    frames: Annotated[str | None, DisallowNone, optional("FRAMES")] = None
    """Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."""

    arguments: ClassVar[Mapping[str, str]] = {"span": "--frames"}

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.codec.packets import play
        from morgs_mi.io.compressed_ply import write_compressed_ply
        from morgs_mi.io.ply import write_ply
        from morgs_mi.playback.export.clips import select_frames, write_each
        from morgs_mi.playback.export.order import by_place

        frames = select_frames(stream, self.frames)
        output, chosen = destination(stream.path, self.output, PLY, self.format)
        with progress() as report:
            tick = partial(report, "Writing")
            if chosen.name == "compressed.ply":
                write_each(by_place(stream), output, chosen.ending, write_compressed_ply, frames, tick)
            else:
                write_each(play(stream), output, chosen.ending, write_ply, frames, tick)
        print_result(f"{output}: {len(frames)} PLY {'file' if len(frames) == 1 else 'files'}.")


@dataclass(frozen=True)
class Gltf:
    """Write a .glb file per frame: glTF 2.0 with KHR_gaussian_splatting, rotated to y up."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
    output: Annotated[Positional[Path | None], DisallowNone, place("FOLDER")] = None
    """New folder for 0000.glb, ..., or FILE.glb for one frame; by default OUT/gltf."""
    frames: Annotated[str | None, DisallowNone, optional("FRAMES")] = None
    """Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."""

    arguments: ClassVar[Mapping[str, str]] = {"span": "--frames"}

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.codec.packets import play
        from morgs_mi.playback.export.axes import gltf_axes
        from morgs_mi.playback.export.clips import select_frames, write_each
        from morgs_mi.playback.export.gltf_export import write_gltf

        frames = select_frames(stream, self.frames)
        output, chosen = destination(stream.path, self.output, GLTF)
        axes = gltf_axes(stream.cameras)
        with progress() as report:
            write = partial(write_gltf, axes=axes)
            write_each(play(stream), output, chosen.ending, write, frames, partial(report, "Writing"))
        print_result(f"{output}: {len(frames)} glTF {'file' if len(frames) == 1 else 'files'}.")


@dataclass(frozen=True)
class Usd:
    """Write an OpenUSD stage with a time sample per frame: ParticleField3DGaussianSplat, rotated to y up."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
    output: Annotated[Positional[Path | None], DisallowNone, place("FILE")] = None
    """FILE.usd, .usdc (binary), .usda (text) or .usdz (package); by default OUT/stream.usdc."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(_names(USD))] = None
    """Format: usdc, usd, usda or usdz; by default by the name."""
    frames: Annotated[str | None, DisallowNone, optional("FRAMES")] = None
    """Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."""
    half: Flag = False
    """Half precision of all attributes but the positions."""

    arguments: ClassVar[Mapping[str, str]] = {"span": "--frames"}

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.playback.export.clips import select_frames
        from morgs_mi.playback.export.usd import write_usd

        frames = select_frames(stream, self.frames)
        output, _ = destination(stream.path, self.output, USD, self.format)
        with progress() as report:
            write_usd(stream, output, frames, self.half, partial(report, "Writing"))
        print_result(f"{output}: {len(frames)} frames, {output.stat().st_size / 1e6:.2f} MB.")


@dataclass(frozen=True)
class Flight:
    """Render a stream along a moving camera into an mp4."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
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

    arguments: ClassVar[Mapping[str, str]] = {"least": "--least-seconds"}

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.playback.export.clips import flight, frame_numbers, named_path, num_images, repeated_frames
        from morgs_mi.playback.export.frames import write_images
        from morgs_mi.playback.player import stream_exposure

        frames = frame_numbers(stream)
        if self.freeze is not None and self.freeze not in frames:
            raise ValueError(f"--freeze must be in {frames[0]} to {frames[-1]}, got {self.freeze}.")
        path = named_path(stream, self.path, self.degrees, self.least_seconds)
        path = path if self.width is None else path.with_width(self.width)
        path = path if self.seconds is None else path.with_duration(self.seconds)
        output, _ = destination(stream.path, self.output, VIDEO, stem=Path(self.path).stem)
        count = num_images(stream, path)
        with progress() as report:
            clip = repeated_frames(stream, self.freeze, self.back_and_forth)
            images = flight(stream, path, self.channels, clip)
            stops = stream_exposure(stream) if self.display_exposure is None else self.display_exposure
            write_images(images, stream.fps, output, lambda done: report("Rendering", done, count), None, stops)
        print_result(f"{output}: {path.seconds:.1f} s, {path.keys[0].width}x{path.keys[0].height}.")


@dataclass(frozen=True)
class Tracks:
    """Write the track of every Gaussian as NumPy arrays: ids, frames, positions, confidence."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
    output: Annotated[Positional[Path | None], DisallowNone, place("FILE.npz")] = None
    """File for the tracks; by default OUT/tracks.npz."""

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.tracks import extract_tracks, write_tracks

        output, _ = destination(stream.path, self.output, TRACKS)
        total = len(frame_numbers(stream))
        with progress() as report:
            tracks = extract_tracks(stream, lambda done: report("Following", done, total))
        write_tracks(output, tracks)
        T, N = tracks.positions.shape[:2]
        print_result(f"{output}: {N} Gaussians through {T} frames.")


@dataclass(frozen=True)
class Web:
    """Write a web page that plays the stream without a server, or a folder for a server."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""
    output: Annotated[Positional[Path | None], DisallowNone, place("FILE.html")] = None
    """FILE.html, or a new folder with the page, the stream and a module for three.js, for hosting; by default
    OUT/player.html or OUT/web."""
    format: Annotated[str | None, DisallowNone, optional("NAME"), one_of(_names(WEB))] = None
    """Format: html or folder; by default by the name."""
    title: Annotated[str | None, DisallowNone, optional("TEXT")] = None
    """Title of the page; by default the name of the stream's folder or file."""

    def run(self, stream: PlayableStream) -> None:
        from morgs_mi.playback.export.clips import frame_numbers
        from morgs_mi.playback.export.web import write_web_folder, write_web_page

        output, chosen = destination(stream.path, self.output, WEB, self.format)
        total, write = len(frame_numbers(stream)), write_web_folder if chosen.folder else write_web_page
        with progress() as report:
            size = write(stream, output, self.title, lambda done: report("Checking", done, total))
        print_result(f"{output}: {total} {'frame' if total == 1 else 'frames'}, {size / 1e6:.2f} MB.")


@dataclass(frozen=True)
class Export:
    """Export a stream for other programs."""

    kind: Annotated[
        Annotated[Ply, tyro.conf.subcommand("ply")]
        | Annotated[Gltf, tyro.conf.subcommand("gltf")]
        | Annotated[Usd, tyro.conf.subcommand("usd")]
        | Annotated[Flight, tyro.conf.subcommand("video")]
        | Annotated[Tracks, tyro.conf.subcommand("tracks")]
        | Annotated[Web, tyro.conf.subcommand("web")],
        arg(name=""),
    ]

    drop_invalid: DropInvalid = False

    def run(self) -> None:
        drawn = isinstance(self.kind, Flight | Web)
        self.kind.run(opened(self.kind.out, self.drop_invalid, drawn))
