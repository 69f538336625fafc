"""What the commands that read a stream, or a file of Gaussians, have in common."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import FlagCreatePairsOff, Positional, arg

from morgs_mi.cli.console import print_result, progress
from morgs_mi.cli.settings import options
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.platform.checks import check_number
from morgs_mi.platform.progress import Report
from morgs_mi.playback.default_rig import DEFAULT_RIG
from morgs_mi.playback.export.formats import Format, destination

_DROP = (
    "Leave out the Gaussians of a file whose numbers are not finite or absurdly large, however "
    "many they are."
)
DropInvalid = Annotated[bool, FlagCreatePairsOff, arg(help=_DROP)]
"""Option of the commands that read files of Gaussians."""
_SPAN = "Frames to write: 12, 10:20 (20 excluded) or 0:100:5; all by default."
FRAMES = arg(metavar="FRAMES", help=_SPAN)


_BACKGROUND = (
    "Colour behind the Gaussians: black, grey, white or #rrggbb; by default the fit's, which is "
    "usually black."
)
Background = Annotated[str | None, arg(metavar="COLOR", help=_BACKGROUND)]
"""Option of the commands that draw a stream."""
_CAMERA = "Camera at which the page opens, by name or index; by default the first one."
PageCamera = Annotated[str | None, arg(metavar="CAMERA", help=_CAMERA)]
"""Option of the commands that show a page."""
_COLORS = {"black": "#000000", "grey": "#808080", "white": "#ffffff"}


def on_background(stream: FrameSource, color: str | None) -> None:
    """Draw a stream over another colour, None: over its own.

    Raises:
        ValueError: it is no colour.
    """
    from morgs_mi.playback.stream_header import render_config

    if color is None:
        return
    match = re.fullmatch("#" + 3 * "([0-9a-f]{2})", _COLORS.get(color, color.lower()))
    if match is None:
        raise ValueError(
            f"--background must be {', '.join(_COLORS)} or #rrggbb, got {color}; choose one."
        )
    background = tuple(int(digits, 16) / 255 for digits in match.groups())
    render = asdict(replace(render_config(stream), background=background))
    config = stream.metadata.get("config", {})
    stream.metadata = {**stream.metadata, "config": {**config, "render": render}}


def with_first_camera(stream: FrameSource, camera: str | None) -> str | None:
    """Put the camera at which a page opens before the others, and return its name; None: leave it.

    Raises:
        ValueError: the stream has no such camera.
    """
    from morgs_mi.playback.stream_header import find_camera

    if camera is None:
        return None
    first = find_camera(stream, camera)
    stream.cameras = (first, *(other for other in stream.cameras if other is not first))
    return first.name


def opened(
    out: Path, drop_invalid: bool, drawn: bool = True, skip_damaged: bool = False
) -> FrameSource:
    """Return the stream that a command reads.

    Args:
        out: folder of a fit, a stream file, or a file of Gaussians.
        drop_invalid: whether Gaussians with invalid numbers are left out, however many they are.
        drawn: whether images or pages are made, which are without a few invalid Gaussians in any
            case; Gaussians that are written for other programs are not.
        skip_damaged: as for `open_stream`.

    Raises:
        FileNotFoundError, ValueError: as for `open_stream`.
    """
    from morgs_mi.playback.streams import DRAWN, open_stream

    return open_stream(out, 1.0 if drop_invalid else DRAWN if drawn else 0.0, skip_damaged)


def print_view(stream: FrameSource, choice: str | None, more: str = "") -> None:
    """Print from where Gaussians without a recording are seen, unless the user has chosen it, and
    the cameras that may be chosen, of which `more` is no name.
    """
    if choice is None and stream.metadata.get(DEFAULT_RIG) is True:
        first, *others = [camera.name for camera in stream.cameras]
        print_result(f"Seen from {first} (most detail); also --camera {', '.join(others)}{more}.")


def print_between(stream: FrameSource) -> None:
    """Print what the fit expects of views between the cameras."""
    from morgs_mi.playback.stream_header import between_cameras

    if quality := between_cameras(stream):
        print_result(f"Views between the cameras: {quality}.")


def rendering(report: Report, count: int) -> Callable[[int], None]:
    """Return the function that is called with the number of images done, of `count`."""

    def show(done: int) -> None:
        report("Rendering", done, count)

    show(0)
    return show


def shown_exposure(stream: FrameSource, stops: float | None) -> float:
    """Return the stops by which images of a stream are brightened: the given ones, or where they
    are None, the stream's.
    """
    from morgs_mi.playback.stream_header import stream_exposure

    if stops is None:
        return stream_exposure(stream)
    check_number("images", "display_exposure", stops, "[-100, 100]")
    return stops


def relative_to(stream: FrameSource) -> str:
    """Return the origin of the centres in files of float32 in words, empty if it is 0."""
    from morgs_mi.playback.stream_header import stream_origin

    origin = stream_origin(stream)
    text = ", relative to the origin ({:.10g}, {:.10g}, {:.10g})".format(*origin)
    return text if any(origin) else ""


@options
class ExportKind:
    """A kind of export: options, with `formats` and the method `write` of their writer.

    Its option `output` is the file or folder; one called `path` gives it a name. `drawn`: as for
    `opened`.
    """

    source: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians."""

    formats: ClassVar[tuple[Format, ...]]
    drawn: ClassVar[bool] = False

    def run(self, stream: FrameSource) -> None:
        options = vars(self)
        stem = Path(options.get("path", "")).stem
        output, chosen = destination(stream.path, options["output"], self.formats, stem)
        with progress() as report:
            summary = self.write(stream, output, chosen, report)
        print_result(f"{output}: {summary}.")

    def write(self, stream: FrameSource, output: Path, chosen: Format, report: Report) -> str:
        """Write a stream in a format, and return a summary."""
        raise NotImplementedError
