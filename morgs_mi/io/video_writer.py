"""Atomic writing of video files and folders of images; a frame is an RGB uint8 array [H, W, 3]."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.core.files import atomic_folder, atomic_path
from morgs_mi.core.png import png_bytes

PLAYABLE = "vp09"
"""Codec of videos in .mp4 that browsers and players open: VP9, which OpenCV's wheels have."""


def write_video(
    path: str | Path, frames: Iterable[np.ndarray], fps: float, codec: str = "FFV1"
) -> None:
    """Write RGB uint8 frames [H, W, 3] as a video, or as a folder of PNGs where `path` has no
    suffix.

    The file gets its name only after all of it could be read back, so it is never incomplete.

    Args:
        path: ``.mp4``, ``.mkv``, ``.avi``, ... or a folder that does not exist yet.
        frames: at least one, all of one even width and height (any size in a folder).
        fps: frames per second; not stored in a folder.
        codec: OpenCV's four-character code. ``FFV1`` is lossless, in .mp4 too, but no browser plays
            it, unlike `PLAYABLE`. On a path-traced box at 304x224, 4:2:0 chroma alone allows 42.4
            dB; ``vp09`` reaches 39.2 dB at 37 ms a frame, ``mp4v`` 37.6 dB at 0.6 ms. OpenCV has no
            setting of the quality (opencv issue 24570), and its wheels have no ``avc1``.

    Raises:
        ValueError: there are no frames, or a frame is not as described.
        OSError: the encoder is missing, the folder exists, or the written frames cannot be read
            back.
    """
    path = Path(path)
    frames = _checked(path, frames)
    if not path.suffix:
        with atomic_folder(path, "write_video()") as folder:
            for i, frame in enumerate(frames):
                # Not cv2.imwrite, which does not report why it failed.
                (folder / f"{i:04d}.png").write_bytes(png_bytes(frame))
        return
    with atomic_path(path, "write_video()", parents=True) as partial:
        first = next(frames)
        size = first.shape[1::-1]
        fourcc = cv2.VideoWriter.fourcc(*codec)
        encoder = cv2.VideoWriter(f"file:{partial}", cv2.CAP_FFMPEG, fourcc, fps, size)
        count = 0
        try:
            if not encoder.isOpened():
                raise OSError(f"OpenCV has no encoder {codec!r} for it; try the codec FFV1 or mp4v")
            for frame in chain([first], frames):
                encoder.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
                count += 1
        finally:
            encoder.release()
        # OpenCV's writer reports no failure, not even a full disk, so the decodable frames are
        # counted.
        stream = cv2.VideoCapture(f"file:{partial}", cv2.CAP_FFMPEG)
        readable = 0
        while stream.grab():
            readable += 1
        stream.release()
        if readable != count:
            raise OSError(f"{count} frames were written but {readable} can be read back")


def _checked(path: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for i, frame in enumerate(frames):
        shape = shape or (*frame.shape[:2], 3)
        # OpenCV drops an odd column or row of a video.
        is_odd = path.suffix and (shape[0] % 2 or shape[1] % 2)
        if frame.dtype != np.uint8 or frame.shape != shape or is_odd:
            raise ValueError(
                f"write_video({path}): frame {i} must be uint8 {[*shape]} like the first, in a "
                f"video of even sizes, got {frame.dtype} {[*frame.shape]}; convert it first."
            )
        yield frame
    if shape is None:
        raise ValueError(f"write_video({path}): at least one frame was expected, got none.")
