"""`morgs-mi export gltf` and `usd`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from morgs_mi.cli.settings import (
    Flag,
    options,
    place,
)
from morgs_mi.cli.streams import FRAMES, ExportKind, relative_to
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.progress import Report
from morgs_mi.playback.export.formats import GLTF, USD, Format

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource


@options
class Gltf(ExportKind):
    """Write a .glb file per frame: glTF 2.0 with KHR_gaussian_splatting, rotated to y up."""

    output: Annotated[Positional[Path | None], place("FOLDER")] = None
    """New folder for 0000.glb, ..., or FILE.glb for one frame; by default gltf beside the stream.
    """
    frames: Annotated[str | None, FRAMES] = None

    formats = GLTF

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.codec.frame_source import play
        from morgs_mi.extras.exports.gltf_export import LINEAR, SRGB, gltf_axes, write_gltf
        from morgs_mi.playback.export.clips import select_frames, write_each

        frames = select_frames(stream, self.frames)
        color_space = LINEAR if "transfer" in stream.metadata else SRGB
        write = partial(write_gltf, axes=gltf_axes(stream.cameras), color_space=color_space)
        write_each(
            play(stream), output, f".{chosen.name}", write, frames, partial(report, "Writing")
        )
        return quantity(len(frames), "glTF file") + relative_to(stream)


@options
class Usd(ExportKind):
    """Write an OpenUSD stage with a time sample per frame: ParticleField3DGaussianSplat, rotated to
    y up.
    """

    output: Annotated[Positional[Path | None], place("FILE")] = None
    """FILE.usd, .usdc (binary), .usda (text) or .usdz (package); by default stream.usdc
    beside the stream."""
    frames: Annotated[str | None, FRAMES] = None
    half: Flag = False
    """Half precision of all attributes but the positions."""

    formats = USD

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        from morgs_mi.extras.exports.usd import write_usd
        from morgs_mi.playback.export.clips import select_frames

        frames = select_frames(stream, self.frames)
        write_usd(stream, output, frames, self.half, partial(report, "Writing"))
        return f"{quantity(len(frames), 'frame')}, {output.stat().st_size / 1e6:.2f} MB"
