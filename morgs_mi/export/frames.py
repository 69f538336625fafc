"""A stream's frames as files: a video that ordinary players play, EXR files for compositing, PNG files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.files import atomic_folder
from morgs_mi.io.exr import write_exr
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.player import channel_image, render_stream
from morgs_mi.playback.visualise import side_by_side, write_png

__all__ = ["PLAYABLE", "even", "exr_channels", "linear_light", "write_frames"]

# Of what OpenCV's wheels can encode, what every browser plays: H.264 is not among it, and none plays mp4v.
PLAYABLE = "vp09"
_EXR_NAMES = {
    "color": ("R", "G", "B"),
    "alpha": ("A",),
    "depth": ("depth.Y",),
    "motion": ("motion.X", "motion.Y"),
    "confidence": ("confidence.Y",),
}


def write_frames(
    stream: StreamReader,
    camera: Camera,
    output: str | Path,
    channels: Sequence[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Render a stream for one camera into files, which appear whole or not at all.

    Args:
        stream: the file.
        camera: any view.
        output: ``FILE.mp4`` for a video of the channels side by side, a folder ending in ``png`` for the same as
            ``0000.png`` ..., any other folder for multichannel ``0000.exr`` ... (see `exr_channels`).
        channels: out of `CHANNELS`; by default the colour, in EXR files all that the stream holds.
        progress: called with the number of frames done.

    Raises:
        ValueError: an unknown channel, one that the stream does not hold, another kind of video, a stream that is
            truncated, broken or without a frame.
        OSError: the folder exists, or the files cannot be written.
    """
    output = Path(output)
    name = output.name.lower()
    video, png = name.endswith(".mp4"), name.endswith("png")
    if output.suffix.lower() not in ("", ".mp4", ".png", ".exr"):
        raise ValueError(
            f"{output}: the output must be FILE.mp4, or a folder ending in png or exr, got {output.suffix!r}."
        )
    rendered = render_stream(stream, camera, channels or (("color",) if video or png else None))

    def frames() -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
        for done, (frame, images) in enumerate(rendered, start=1):
            yield frame, images
            if progress is not None:
                progress(done)

    if video:
        write_video(output, (even(_picture(images)) for _, images in frames()), stream.fps, PLAYABLE)
        return
    with atomic_folder(output, "write_frames()") as folder:
        for frame, images in frames():
            if png:
                write_png(folder / f"{frame:04d}.png", _picture(images))
            else:
                write_exr(folder / f"{frame:04d}.exr", exr_channels(images))
        if not any(folder.iterdir()):
            raise ValueError(f"{output}: at least one frame was expected, got none; the stream has a header alone.")


def exr_channels(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return rendered images [H, W, 1 to 3] as EXR channels [H, W] under the names of the renderer's AOVs.

    Colour becomes linear light (R, G, B), as EXR readers expect; motion stays in pixels, depth in world units.
    """
    planes = {**images, **({"color": linear_light(images["color"])} if "color" in images else {})}
    return {name: plane[..., i] for key, plane in planes.items() for i, name in enumerate(_EXR_NAMES[key])}


def even(picture: np.ndarray) -> np.ndarray:
    """Return the picture [H, W, 3] with its last row and column doubled where it takes that to make them even."""
    H, W = picture.shape[:2]
    return np.pad(picture, ((0, H % 2), (0, W % 2), (0, 0)), mode="edge")


def _picture(images: Mapping[str, np.ndarray]) -> np.ndarray:
    return side_by_side([channel_image(name, image) for name, image in images.items()])


def linear_light(encoded: np.ndarray) -> np.ndarray:
    """Undo sRGB's encoding (IEC 61966-2-1), beyond 1 too, where splats overshoot."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4)
