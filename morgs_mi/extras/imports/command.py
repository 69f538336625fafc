"""`morgs-mi import`: frames of other tools as a stream."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.capture.outputs import check_output
from morgs_mi.cli.console import print_next, print_result, progress
from morgs_mi.cli.settings import options
from morgs_mi.cli.streams import DropInvalid
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.platform.checks import quantity
from morgs_mi.playback.default_rig import Axes


@options
class Import:
    """Write frames of other tools, one file of Gaussians each, as a stream."""

    # One list, as for `cp`: the parser cannot split two of them where options follow.
    paths: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="FRAMES [FRAMES ...] OUT"),
    ] = ()
    """Frames: a folder with a .ply, .compressed.ply or .splat file for each, or the files in the
    order of the frames. Last, OUT: a folder for stream.morgs, or a new file whose name ends in
    .morgs.
    """
    fps: float = 30.0
    """Frames per second."""
    axes: Annotated[Axes, arg(metavar="NAME")] = "y-down"
    """Direction that is up in the files: y-down, y-up or z-up."""
    quality: Annotated[float, arg(metavar="FLOAT")] = CodecConfig().quality
    """Precision of the stream; 2 halves all errors."""
    target_size: Annotated[int, arg(metavar="INT")] = CodecConfig().target_size
    """Most bytes of a frame that continues the one before; 0: no limit."""
    keyframe_interval: Annotated[int, arg(metavar="INT")] = CodecConfig().keyframe_interval
    """Frames between two keyframes; 0: only where they are needed."""
    drop_invalid: DropInvalid = False

    def run(self) -> None:
        from morgs_mi.extras.imports.import_frames import import_frames

        if len(self.paths) < 2:
            raise ValueError(
                "morgs-mi import: expected FRAMES and OUT, got fewer; see morgs-mi import --help."
            )
        *frames, out = self.paths
        config = CodecConfig(
            quality=self.quality,
            target_size=self.target_size,
            keyframe_interval=self.keyframe_interval,
        )
        with progress() as report:
            result = import_frames(
                frames,
                check_output(out),
                self.fps,
                config,
                self.axes,
                lambda done, of: report("Importing", done, of),
                most_invalid=1.0 if self.drop_invalid else 0.0,
            )
        sets = quantity(result.num_keyframes, "set")
        print_result(
            f"{result.path}: {quantity(result.num_frames, 'frame')}, {sets} of Gaussians, "
            f"{result.num_bytes / 1e6:.2f} MB."
        )
        print_next("view", out)
