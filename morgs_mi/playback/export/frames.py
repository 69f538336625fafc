"""Export of rendered frames: videos for common players, EXR files for compositing, PNG files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from morgs_mi.core.color_space import decode_light, exposed
from morgs_mi.core.types import Arrays
from morgs_mi.io.exr import write_exr
from morgs_mi.io.video_writer import H264, VP9, write_video
from morgs_mi.platform.png import png_bytes
from morgs_mi.playback.export.formats import IMAGES, choose_format, frame_files
from morgs_mi.playback.player import explained_image
from morgs_mi.playback.visualise import side_by_side, to_uint8, write_png
from morgs_mi.render.channels import exr_names

# Of the videos, by format.
_ENCODERS = {"mp4": H264, "webm": VP9}
# Index and channels [H, W, C] by name.
_Frame = tuple[int, Arrays]


def write_images(
    rendered: Iterable[_Frame],
    fps: float,
    output: str | Path,
    progress: Callable[[int], None] | None = None,
    display_exposure: float = 0.0,
    transparent: bool = False,
    shown: Sequence[str] | None = None,
) -> None:
    """Write rendered frames, pairs of index and channels [H, W, C] by name, into files, atomically.

    Args:
        rendered: the frames, as `render_stream` yields them.
        fps: frames per second.
        output: ``FILE.mp4`` (H.264) or ``FILE.webm`` (VP9) for a video of the channels side by
            side, a folder ending in ``png`` for the same images as ``0000.png`` ..., any other
            folder for multichannel ``0000.exr`` ... (see `exr_channels`), or ``FILE.png`` or
            ``FILE.exr`` for a single frame.
        progress: called with the number of frames done.
        display_exposure: stops by which videos and PNG files are brightened before they are
            clipped at white.
        transparent: write colour and alpha, rendered over black, as PNG files with straight alpha;
            programs composite these in sRGB, as splats are blended, and differ by up to 0.14 where
            they do in linear light.
        shown: channels in videos and PNG files, out of those that were rendered; None: all. Motion
            is over the grey colour if that was rendered as well.

    Raises:
        ValueError: another type of video.
        OSError: the folder exists, or a file cannot be written.
    """
    choice = choose_format(IMAGES, output)
    kind = choice.name
    exposure = 0.0 if kind == "exr" else display_exposure

    def display_frames() -> Iterator[_Frame]:
        for count, (frame, images) in enumerate(rendered, start=1):
            if "color" in images:
                images = {**images, "color": exposed(images["color"], exposure)}
            yield frame, images
            if progress is not None:
                progress(count)

    frames = display_frames()
    if kind in _ENCODERS:
        movie = (pad_to_even(_combined_image(images, shown)) for _, images in frames)
        write_video(output, movie, fps, _ENCODERS[kind])
        return
    with frame_files(output, choice.is_file(output), f".{kind}", "write_images()") as file_of:
        for frame, images in frames:
            path = file_of(frame)
            if kind == "exr":
                write_exr(path, exr_channels(images))
            elif transparent:
                straight_colors = to_uint8(images["color"] / np.clip(images["alpha"], 1e-6, 1))
                bytes_of_alpha = np.uint8(255 * images["alpha"].clip(0, 1) + 0.5)
                rgba = np.concatenate([straight_colors, bytes_of_alpha], axis=2)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(png_bytes(rgba))
            else:
                write_png(path, _combined_image(images, shown))


def exr_channels(images: Arrays) -> Arrays:
    """Return rendered images [H, W, C] as EXR channels [H, W] under the names of the renderer's
    AOVs.

    Colour is R, G, B in linear light, as EXR readers expect, and alpha is A. Other channels are
    called ``depth.Y`` if they have one component, ``motion.X``, ``motion.Y`` if they have several.
    Motion is in pixels, depth in world units.
    """
    planes = {**images, **({"color": decode_light(images["color"])} if "color" in images else {})}
    return {
        name: plane[..., i]
        for key, plane in planes.items()
        for i, name in enumerate(_exr_names(key, plane.shape[2]))
    }


def _exr_names(channel: str, components: int) -> list[str]:
    if channel == "color":
        return ["R", "G", "B"]
    if channel == "alpha":
        return ["A"]
    if channel in ("splats", "surfaces", "shadow"):  # layers of an inserted scene, see `insert`
        return [f"{channel}.{letter}" for letter in "RGBA"[:components]]
    return exr_names(channel, components)


def pad_to_even(image: np.ndarray) -> np.ndarray:
    """Return the image [H, W, 3] with its last row and column repeated to even numbers."""
    H, W = image.shape[:2]
    return np.pad(image, ((0, H % 2), (0, W % 2), (0, 0)), mode="edge")


def _combined_image(images: Arrays, shown: Sequence[str] | None) -> np.ndarray:
    color = images.get("color")
    names = images if shown is None else shown
    return side_by_side([explained_image(name, images[name], color=color) for name in names])
