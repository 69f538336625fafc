"""Opening of streams."""

from __future__ import annotations

from pathlib import Path

from morgs_mi.codec.reader import StreamReader
from morgs_mi.playback.export.notebook import stream_html
from morgs_mi.playback.player import STREAM

__all__ = ["PlayableStream", "open_stream"]


class PlayableStream(StreamReader):
    """A stream file that plays in the output of a notebook's cell."""

    def _repr_html_(self) -> str:
        return stream_html(self)


def open_stream(out: str | Path) -> PlayableStream:
    """Open a stream file, or the ``stream.morgs`` in the folder of a fit.

    Example:
        >>> stream = morgs_mi.open_stream("out/arm_fit")
        >>> for frame, images in morgs_mi.render_stream(stream, stream.cameras[0]):
        ...     print(frame, images["color"].shape)

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a stream, or its header is broken or missing.
    """
    path = Path(out)
    path = path / STREAM if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a stream, found none; check the path or fit a capture first.")
    return PlayableStream(path)
