"""Opening of streams, and of files with the Gaussians of one frame."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from morgs_mi.codec.container import MAGIC, Packet
from morgs_mi.codec.frame_source import FrameSource, FrameState
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.listing import existing_file, listed
from morgs_mi.io.splats import CONVERT, read_splats, suffix_of
from morgs_mi.platform.checks import errors_at, few, quantity, require
from morgs_mi.platform.files import PROVISIONAL, STREAM
from morgs_mi.playback.default_rig import BOX, DEFAULT_RIG, default_rig, scene_box
from morgs_mi.playback.export.web import stream_html

DRAWN = 0.5
"""Share of invalid Gaussians up to which a file is drawn without them: beyond, the file as a whole
is broken.
"""

_LOG = logging.getLogger(__name__)


class PlayableStream(StreamReader):
    """A stream file that plays in the output of a notebook's cell."""

    def _repr_html_(self) -> str:
        return stream_html(self)


class SplatFile(FrameSource):
    """File with the Gaussians of one frame, of any tool; they are rounded only where it is coded
    into a packet.

    Its cameras are a `default_rig`.

    Args:
        path: ``.ply``, ``.compressed.ply`` or ``.splat``.
        most_invalid: share of Gaussians with invalid numbers that are left out with a warning.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it has no Gaussians, is broken or truncated, or has more invalid Gaussians.
    """

    def __init__(self, path: Path, most_invalid: float = DRAWN) -> None:
        gaussians = read_splats(path, most_invalid)
        with errors_at(path):
            box = scene_box([gaussians])
        self.path = path
        self.fps = 30.0
        self.metadata = {"num_frames": 1, DEFAULT_RIG: True, BOX: box.tolist()}
        self.cameras = default_rig([gaussians], box)
        motion = np.zeros((len(gaussians), 3), np.float32)
        ids = np.arange(len(gaussians), dtype=np.uint32)
        self._state = FrameState(0, ids, replace(gaussians, motion=motion))

    def frame_numbers(self) -> list[int]:
        return [0]

    def states(self, near: int | None = None) -> Iterator[FrameState]:
        yield self._state

    def __iter__(self) -> Iterator[Packet]:
        yield keyframe_packet(self._state.gaussians, 0, self.cameras)

    def _repr_html_(self) -> str:
        return stream_html(self)


def stream_path(out: str | Path) -> Path:
    """Return the path of a stream file or of a file with Gaussians; in the folder of a fit, of its
    ``stream.morgs``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: there is a file of another format, or a folder with fits or files of Gaussians.
    """
    path = Path(out)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; check the path.")
    remedy = f"if {path} is a capture, fit it first: morgs-mi fit {path} OUT"
    if path.is_dir():
        _check_fit(path)
        path = path / STREAM
    existing_file(path, "a stream", remedy)
    with path.open("rb") as file:
        start = file.read(len(MAGIC))
    if start != MAGIC:
        require(
            suffix_of(path) or path.suffix == ".morgs",
            path,
            "expected a stream, or Gaussians as .ply, .compressed.ply or .splat",
            path.name,
            f"name the folder of a fit, fit a capture first, or if it has Gaussians, {CONVERT}",
        )
    return path


def _check_fit(folder: Path) -> None:
    """Check that a folder is not one with several fits, or with files of Gaussians."""
    if not (folder / STREAM).exists():
        inner = [file for file in listed(folder) if suffix_of(file) or (file / STREAM).is_file()]
        require(
            not inner,
            folder,
            "expected a stream",
            f"a folder with {few([file.name for file in inner], 3)}",
            "name one of them, or make a stream of files of Gaussians by `morgs-mi import`",
        )


def open_stream(
    out: str | Path, most_invalid: float = DRAWN, skip_damaged: bool = False
) -> PlayableStream | SplatFile:
    """Open a stream file, the ``stream.morgs`` in the folder of a fit, or a file with Gaussians as
    one frame.

    Files with Gaussians are ``.ply`` files in the layout of 3D Gaussian Splatting,
    ``.compressed.ply`` and ``.splat``. A warning is logged for a provisional first frame, which a
    fit that was killed leaves behind.

    Args:
        out: the file or folder.
        most_invalid: share of Gaussians of such a file that may have numbers that are not finite or
            above 1e12; they are left out with a warning. 0: none.
        skip_damaged: leave out the damaged frames of a stream, and those up to the next intact
            keyframe, with a warning that names them.

    Example:
        >>> stream = morgs_mi.open_stream("out/arm_fit")
        >>> for frame, images in morgs_mi.render_stream(stream, stream.cameras[0]):
        ...     print(frame, images["color"].shape)

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a stream, or its header is broken or missing; or it has no
            Gaussians, or more invalid ones.
    """
    path = stream_path(out)
    if path.name == PROVISIONAL:
        _LOG.warning(
            "%s: a provisional first frame of a fit that is still running or was killed; its "
            "Gaussians are not final.",
            path,
        )
    if suffix_of(path):
        return SplatFile(path, most_invalid)
    stream = PlayableStream(path, skip_damaged)
    problems = []
    if stream.skipped:
        problems.append(f"the damaged frames {few(stream.skipped)} are skipped")
    if not stream.closed():
        problems.append(
            f"it ends after {quantity(len(stream.index()), 'packet')} without an index, and may "
            "lack later frames"
        )
    if problems:
        _LOG.warning("%s: %s.", stream.path, "; ".join(problems))
    return stream
