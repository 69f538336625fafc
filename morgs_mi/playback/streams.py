"""Opening of streams, and of files with the Gaussians of one frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.packets import WholeFrame
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.model_cameras import model_cameras
from morgs_mi.io.splats import read_splats, suffix_of
from morgs_mi.playback.default_rig import DEFAULT_RIG, default_rig
from morgs_mi.playback.export.notebook import stream_html
from morgs_mi.playback.player import STREAM

__all__ = ["PlayableStream", "SplatFile", "open_stream", "stream_path"]


class PlayableStream(StreamReader):
    """A stream file that plays in the output of a notebook's cell."""

    def _repr_html_(self) -> str:
        return stream_html(self)


class SplatFile(PlayableStream):
    """File with the Gaussians of one frame, of any tool, as a stream.

    Its cameras are those of its training, if a `cameras.json` belongs to it (`model_cameras`), or a `default_rig`.

    Args:
        path: ``.ply``, ``.compressed.ply`` or ``.splat``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it has no Gaussians, is broken or truncated.
    """

    def __init__(self, path: Path) -> None:
        gaussians, trained = read_splats(path), model_cameras(path)
        self.path, self.fps, self.metadata = path, 30.0, {"num_frames": 1, DEFAULT_RIG: not trained}
        try:
            self.cameras = trained or default_rig([gaussians])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        self._frame = WholeFrame(gaussians, self.cameras)

    def __iter__(self) -> Iterator[Packet]:
        return iter((self._frame,))

    def near(self, frame: int) -> Iterator[Packet]:
        return iter(self)

    def closed(self) -> bool:
        return True

    def index(self) -> list[tuple[int, int, int]]:
        return [(PacketKind.KEYFRAME, 0, 0)]

    def check(self) -> tuple[list[tuple[int, int, int]], int]:
        raise ValueError(
            f"{self.path}: expected a stream file, got a file of Gaussians; `morgs-mi import` converts it."
        )


def stream_path(out: str | Path) -> Path:
    """Return the path of a stream file or of a file with Gaussians; in the folder of a fit, of its ``stream.morgs``.

    Raises:
        FileNotFoundError: there is no such file.
    """
    path = Path(out)
    path = path / STREAM if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a stream, found none; check the path or fit a capture first.")
    return path


def open_stream(out: str | Path) -> PlayableStream:
    """Open a stream file, the ``stream.morgs`` in the folder of a fit, or a file with Gaussians as one frame.

    Files with Gaussians are ``.ply`` files in the layout of 3D Gaussian Splatting, ``.compressed.ply`` and ``.splat``.

    Example:
        >>> stream = morgs_mi.open_stream("out/arm_fit")
        >>> for frame, images in morgs_mi.render_stream(stream, stream.cameras[0]):
        ...     print(frame, images["color"].shape)

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a stream, or its header is broken or missing; or it has no Gaussians.
    """
    path = stream_path(out)
    return SplatFile(path) if suffix_of(path) else PlayableStream(path)
