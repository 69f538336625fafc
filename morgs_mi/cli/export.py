"""`morgs-mi export`: a stream in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result, progress

__all__ = ["Export"]


@dataclass(frozen=True)
class Ply:
    """Write a PLY file per frame in the layout of 3D Gaussian Splatting, in the capture's axes."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    output: Path | None = None
    """New folder for 0000.ply, ...; by default OUT/ply."""
    frames: str | None = None
    """Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."""

    def run(self) -> None:
        from morgs_mi.export.clips import select_frames, write_each
        from morgs_mi.io.ply import write_ply
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.out)
        frames, output = select_frames(stream, self.frames), self.output or stream.path.with_name("ply")
        with progress() as report:
            write_each(stream, output, ".ply", write_ply, frames, lambda done, of: report("Writing", done, of))
        print_result(f"{output}: {len(frames)} PLY files.")


@dataclass(frozen=True)
class Gltf:
    """Write a .glb file per frame: glTF 2.0 with KHR_gaussian_splatting, rotated to y up."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    output: Path | None = None
    """New folder for 0000.glb, ...; by default OUT/gltf."""
    frames: str | None = None
    """Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."""

    def run(self) -> None:
        from morgs_mi.export.axes import gltf_axes
        from morgs_mi.export.clips import select_frames, write_each
        from morgs_mi.export.gltf import write_gltf
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.out)
        frames, output = select_frames(stream, self.frames), self.output or stream.path.with_name("gltf")
        axes = gltf_axes(stream.cameras)
        with progress() as report:
            write_each(
                stream,
                output,
                ".glb",
                lambda path, gaussians: write_gltf(path, gaussians, axes),
                frames,
                lambda done, of: report("Writing", done, of),
            )
        print_result(f"{output}: {len(frames)} glTF files.")


@dataclass(frozen=True)
class Flight:
    """Render a stream along a moving camera into an mp4."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    path: str = "between"
    """Camera path: between (through the rig's cameras), orbit (around the scene), or a JSON file (docs/exports.md)."""
    output: Path | None = None
    """FILE.mp4; by default OUT/PATH.mp4."""
    seconds: float | None = None
    """Duration in seconds; by default that of the clip or the JSON file."""
    degrees: float | None = None
    """Angle of an orbit; below 360 the camera swings to both sides. By default the extent of the rig."""
    freeze: int | None = None
    """Frame to freeze time at; by default the clip plays and repeats."""
    width: int | None = None
    """Width of the video; by default that of the first camera or the JSON file."""
    channels: tuple[Literal["color", "motion", "confidence", "depth", "alpha"], ...] = ("color",)
    """Channels to render, side by side."""

    def run(self) -> None:
        from morgs_mi.codec.packets import play
        from morgs_mi.export.clips import frame_numbers, write_flight
        from morgs_mi.export.paths import focus, load_path, orbit, through_cameras
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.out)
        clip = len(frame_numbers(stream)) / stream.fps
        if self.path == "between":
            path = through_cameras(stream.cameras, clip)
        elif self.path == "orbit":
            means = next(gaussians for _, gaussians in play(stream)).numpy()["means"]
            path = orbit(stream.cameras, focus(stream.cameras, means), self.degrees, clip)
        else:
            path = load_path(self.path, stream.cameras)
        path = path if self.seconds is None else path.with_duration(self.seconds)
        if self.width is not None:
            height = round(self.width * path.keys[0].height / path.keys[0].width)
            path = replace(path, keys=tuple(key.resized(self.width, height) for key in path.keys))
        output = self.output or stream.path.with_name(f"{Path(self.path).stem}.mp4")
        with progress() as report:
            write_flight(
                stream,
                path,
                output,
                self.channels,
                self.freeze,
                lambda done, of: report("Rendering", done, of),
            )
        print_result(f"{output}: {path.seconds:.1f} s, {path.keys[0].width}x{path.keys[0].height}.")


@dataclass(frozen=True)
class Tracks:
    """Write the track of every Gaussian as NumPy arrays: ids, frames, positions, confidence."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    output: Path | None = None
    """FILE.npz; by default OUT/tracks.npz."""

    def run(self) -> None:
        from morgs_mi.export.clips import frame_numbers
        from morgs_mi.export.tracks import extract_tracks, write_tracks
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.out)
        output, total = self.output or stream.path.with_name("tracks.npz"), len(frame_numbers(stream))
        with progress() as report:
            tracks = extract_tracks(stream, lambda done: report("Following", done, total))
        write_tracks(output, tracks)
        T, N = tracks.positions.shape[:2]
        print_result(f"{output}: {N} Gaussians through {T} frames.")


@dataclass(frozen=True)
class Web:
    """Write a web page that plays the stream without a server, or a folder for one."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    output: Positional[Path | None] = None
    """FILE.html, or with --folder a new folder; by default OUT/player.html or OUT/web."""
    folder: bool = False
    """Write a folder with the page and the stream as two files, for hosting."""
    title: str | None = None
    """Title of the page; by default the name of the stream's folder or file."""

    def run(self) -> None:
        from morgs_mi.export.clips import frame_numbers
        from morgs_mi.export.web import write_web_folder, write_web_page
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.out)
        output = self.output or stream.path.with_name("web" if self.folder else "player.html")
        total, write = len(frame_numbers(stream)), write_web_folder if self.folder else write_web_page
        with progress() as report:
            size = write(stream, output, self.title, lambda done: report("Checking", done, total))
        print_result(f"{output}: {total} frames, {size / 1e6:.2f} MB.")


@dataclass(frozen=True)
class Export:
    """Export a stream for other programs."""

    kind: Annotated[
        Annotated[Ply, tyro.conf.subcommand("ply")]
        | Annotated[Gltf, tyro.conf.subcommand("gltf")]
        | Annotated[Flight, tyro.conf.subcommand("video")]
        | Annotated[Tracks, tyro.conf.subcommand("tracks")]
        | Annotated[Web, tyro.conf.subcommand("web")],
        arg(name=""),
    ]

    def run(self) -> None:
        self.kind.run()
