"""Opening of the stream or the file of Gaussians that a command reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from morgs_mi.cli.console import print_warning

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource

_DROP = (
    "Leave out the Gaussians of a file whose numbers are not finite or absurdly large, however "
    "many they are."
)
DropInvalid = Annotated[bool, FlagCreatePairsOff, arg(help=_DROP, help_behavior_hint="")]
"""Option of the commands that read files of Gaussians."""


def opened(
    out: Path, drop_invalid: bool, drawn: bool = True, skip_damaged: bool = False
) -> FrameSource:
    """Return the stream that a command reads, and print which cameras a file of Gaussians has.

    Args:
        out: folder of a fit, a stream file, or a file of Gaussians.
        drop_invalid: whether Gaussians with invalid numbers are left out, however many they are.
        drawn: whether images or pages are made, which are without a few invalid Gaussians in any
            case; Gaussians that are written for other programs are not.
        skip_damaged: as for `open_stream`.

    Raises:
        FileNotFoundError, ValueError: as for `open_stream`.
    """
    from morgs_mi.playback.streams import DRAWN, SplatFile, open_stream

    most_invalid = 1.0 if drop_invalid else DRAWN if drawn else 0.0
    stream = open_stream(out, most_invalid, skip_damaged)
    if drawn and isinstance(stream, SplatFile) and stream.cameras_file is not None:
        print_warning(f"Cameras: {stream.cameras_file}.")
    return stream


def shown_exposure(stream: FrameSource, stops: float | None) -> float:
    """Return the stops by which images of a stream are brightened: the given ones, or where they
    are None, the stream's.
    """
    from morgs_mi.playback.stream_header import stream_exposure

    return stream_exposure(stream) if stops is None else stops
