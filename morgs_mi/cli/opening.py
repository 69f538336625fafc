"""Opening of the stream or the file of Gaussians that a command reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from morgs_mi.cli.console import print_warning

if TYPE_CHECKING:
    from morgs_mi.playback.streams import PlayableStream

__all__ = ["DropInvalid", "most_invalid", "opened", "print_cameras"]

_DROP = "Leave out the Gaussians of a file whose numbers are not finite or absurdly large, however many they are."
DropInvalid = Annotated[bool, FlagCreatePairsOff, arg(help=_DROP, help_behavior_hint="")]
"""Option of the commands that read files of Gaussians."""


def most_invalid(drop_invalid: bool, drawn: bool = True) -> float:
    """Return the share of a file's Gaussians that may be invalid and are left out with a warning.

    Args:
        drop_invalid: whether the option is given.
        drawn: whether images or pages are made, which are without a few invalid Gaussians in any case; Gaussians that
            are written for other programs are not.
    """
    from morgs_mi.playback.streams import DRAWN

    return 1.0 if drop_invalid else DRAWN if drawn else 0.0


def opened(out: Path, drop_invalid: bool, drawn: bool = True, skip_damaged: bool = False) -> PlayableStream:
    """Return the stream that a command reads, and print which cameras a file of Gaussians has.

    Args:
        out: folder of a fit, a stream file, or a file of Gaussians.
        drop_invalid: as for `most_invalid`.
        drawn: as for `most_invalid`.
        skip_damaged: as for `open_stream`.

    Raises:
        FileNotFoundError, ValueError: as for `open_stream`.
    """
    from morgs_mi.playback.streams import open_stream

    stream = open_stream(out, most_invalid(drop_invalid, drawn), skip_damaged)
    if drawn:
        print_cameras(stream)
    return stream


def print_cameras(stream: PlayableStream) -> None:
    """Print the file that has the cameras of a file of Gaussians, if there is one."""
    from morgs_mi.playback.streams import SplatFile

    if isinstance(stream, SplatFile) and stream.cameras_file is not None:
        print_warning(f"Cameras: {stream.cameras_file}.")
