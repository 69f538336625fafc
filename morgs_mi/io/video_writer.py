"""Atomic writing of video files and folders of images; a frame is an RGB uint8 array [H, W, 3]."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np

from morgs_mi.platform.checks import kind_of, require
from morgs_mi.platform.files import atomic_folder, atomic_path
from morgs_mi.platform.png import png_bytes

FFV1 = "ffv1"
"""Encoder of lossless videos, in .mp4 too, which no browser plays."""
H264 = "libx264"
"""Encoder of videos in .mp4, which browsers, telephones, players and editors open."""
VP9 = "libvpx-vp9"
"""Encoder of videos in .webm, which browsers open."""
# Constant quality: the demo's video side_by_side.mp4 has 35.2 dB in 25 kB a frame as H.264, 34.3 dB
# in 15 kB as VP9, which takes two to three times as long.
_OPTIONS = {
    H264: {"crf": "20"},
    VP9: {"crf": "24", "b": "0", "cpu-used": "4", "row-mt": "1"},
}
_LONGEST_SIDE = 16384  # px, of libx264
_BT709 = 1  # FFmpeg's number of it, as a matrix, primaries and a transfer function
_LIMITED = 1  # of the range 16 to 235


def write_video(
    path: str | Path, frames: Iterable[np.ndarray], fps: float, codec: str = FFV1
) -> None:
    """Write RGB uint8 frames [H, W, 3] as a video, or as a folder of PNGs where `path` has no
    suffix.

    The file gets its name only after all of it is written, so it is never incomplete. Lossy videos
    have 4:2:0 chroma and are tagged with their colours: BT.709, limited range.

    Args:
        path: ``.mp4``, ``.mkv``, ``.avi``, ... or a folder that does not exist yet.
        frames: at least one, all of one even width and height (any size in a folder).
        fps: frames per second; not stored in a folder.
        codec: FFmpeg's name of an encoder: `FFV1`, `H264`, `VP9`, or another one of 4:2:0 chroma.

    Raises:
        ValueError: there are no frames, a frame is not as described or too large for H.264, or PyAV
            lacks the encoder.
        OSError: the folder exists, or a file cannot be written.
    """
    path = Path(path)
    place = f"write_video({path})"
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{place}: at least one frame was expected, got none.")
    height, width = first.shape[:2]
    frames = _checked(place, chain([first], frames), (height, width, 3))
    if not path.suffix:
        with atomic_folder(path, "write_video()") as folder:
            for i, frame in enumerate(frames):
                # Not cv2.imwrite, which does not report why it failed.
                (folder / f"{i:04d}.png").write_bytes(png_bytes(frame))
        return
    import av  # here, as it takes 80 ms

    require(
        codec in av.codecs_available,
        place,
        f"expected PyAV with the encoder {codec}",
        "one without",
        "install its wheel (pip install --force-reinstall av), or write a folder of PNG files",
    )
    require(
        height % 2 == width % 2 == 0,  # 4:2:0 chroma has a number for 2x2 pixels
        place,
        "expected an even width and height of a video",
        f"{width}x{height}",
        "write images of another width, or a folder of PNG files",
    )
    require(
        codec != H264 or max(height, width) <= _LONGEST_SIDE,
        place,
        f"expected at most {_LONGEST_SIDE} pixels across and down in H.264",
        f"{width}x{height}",
        "write smaller images, fewer channels or FILE.webm",
    )
    with atomic_path(path, "write_video()", parents=True) as partial:
        # Web pages play an .mp4 while it is loaded. A colon in the path would name a protocol.
        flags = {"movflags": "+faststart"}
        with av.open(f"file:{partial}", "w", container_options=flags) as container:
            rate = Fraction(fps).limit_denominator(1001)  # e.g. 24000/1001
            options = _OPTIONS.get(codec, {})
            stream = cast(av.VideoStream, container.add_stream(codec, rate, options=options))
            stream.height = height
            stream.width = width
            stream.pix_fmt = "bgr0"
            if codec != FFV1:
                stream.pix_fmt = "yuv420p"
                encoder = stream.codec_context
                encoder.colorspace = encoder.color_primaries = encoder.color_trc = _BT709
                encoder.color_range = _LIMITED
            for frame in frames:
                rgb = av.VideoFrame.from_ndarray(frame, "rgb24")
                container.mux(
                    stream.encode(
                        rgb.reformat(
                            format=stream.pix_fmt,
                            dst_colorspace=_BT709,
                            dst_color_range=_LIMITED,
                            interpolation="BICUBIC",
                        )
                    )
                )
            container.mux(stream.encode())


def _checked(
    place: str, frames: Iterable[np.ndarray], shape: tuple[int, int, int]
) -> Iterator[np.ndarray]:
    for i, frame in enumerate(frames):
        require(
            frame.dtype == np.uint8 and frame.shape == shape,
            place,
            f"frame {i} must be uint8 {[*shape]} like the first",
            kind_of(frame),
            "convert it first",
        )
        yield frame
