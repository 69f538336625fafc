"""Playback of a stream: rendered frames, the images of their channels, and the playback speed.

The Gaussians of frame t store their displacement since frame t-1. The motion map rendered from them
lies on frame t's pixel grid and holds x_t - x_{t-1}, like the ground truth. Keyframes store no
displacement.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import exposed
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Arrays
from morgs_mi.playback.stream_header import metadata_entry, render_config, stream_exposure
from morgs_mi.playback.visualise import (
    LARGEST_ERROR,
    color_bar,
    confidence_image,
    contact_sheet,
    depth_image,
    depth_limits,
    error_image,
    label,
    motion_image,
    motion_legend,
    to_uint8,
)
from morgs_mi.render.channels import attribute_channels
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

MOTION_SCALE = 0.03
"""Speed at which the colour of motion is fully saturated, as a fraction of the image width per
frame.
"""
_MOST_TIMED_FRAMES = 30
_THUMBNAILS_PER_ROW = 4


def render_stream(
    stream: FrameSource, camera: Camera, channels: Sequence[str] | None = None
) -> Iterator[tuple[int, Arrays]]:
    """Render every frame of a stream for one camera, with the cut-offs of the fit.

    Args:
        stream: the file.
        camera: any view, not necessarily one of the rig.
        channels: such as `alpha`; None for `available_channels`.

    Yields:
        (frame, images): per channel a float32 array [H, W, C], colour display-referred, motion in
        pixels, depth in world units.

    Raises:
        ValueError: an unknown channel, a channel that the stream does not store, or a broken
            packet.
    """
    config = render_config(stream)
    for frame, gaussians in play(stream):
        names = available_channels(gaussians) if channels is None else channels
        yield frame, render(gaussians, camera, names, config)


def camera_sheet(stream: FrameSource, width: int) -> np.ndarray:
    """Return the first frame of a stream as each of its cameras sees it, uint8 RGB: images of one
    size with the names of the cameras, at most four in a row.

    Args:
        stream: the file.
        width: of the image of a camera, pixels.

    Raises:
        ValueError: a broken packet.
    """
    _, gaussians = next(play(stream))
    W, H = stream.cameras[0].with_width(width).size
    images = [
        label(picture(stream, gaussians, camera.resized(W, H)), camera.name)
        for camera in stream.cameras
    ]
    return contact_sheet(np.array_split(images, -(-len(images) // _THUMBNAILS_PER_ROW)))


def has_confidence(stream: FrameSource) -> bool:
    """Return whether a stream stores a confidence, and the fit has learned it.

    Raises:
        ValueError: the header's metadata or the first packet is broken.
    """
    first_frames = islice(play(stream), 1)
    return metadata_entry(stream, "config.motion.learn_confidence") and any(
        gaussians.logit_confidence is not None for _, gaussians in first_frames
    )


def channel_image(
    name: str,
    image: np.ndarray,
    motion_scale: float | None = None,
    color: np.ndarray | None = None,
) -> np.ndarray:
    """Return the visualisation of a rendered channel, uint8 RGB [H, W, 3].

    Args:
        name: of the channel, or `error` for the absolute difference of two images.
        image: values of the channel [H, W, C].
        motion_scale: speed of full saturation in pixels. The default is `MOTION_SCALE`, which is
            the same for all frames of a clip.
        color: image [H, W, 3] under the motion, in grey; without one, no motion is white.
    """
    if name == "motion":
        return motion_image(image, motion_scale or MOTION_SCALE * image.shape[1], color)
    draw = {
        "color": to_uint8,
        "confidence": confidence_image,
        "depth": depth_image,
        "error": error_image,
    }
    return draw[name](image) if name in draw else to_uint8(image.mean(axis=-1))


def explained_image(
    name: str,
    image: np.ndarray,
    motion_scale: float | None = None,
    title: str = "",
    color: np.ndarray | None = None,
) -> np.ndarray:
    """Return the `channel_image` of a channel, unless it is the colour with a label and a legend:
    the wheel of motion in the lower right corner, with the speed at its rim in the label, or a bar
    of the colours along the lower edge, with numbers at both ends.

    Args:
        name: of the channel.
        image: values of the channel [H, W, C].
        motion_scale: as for `channel_image`.
        title: start of the label, by default the name.
        color: as for `channel_image`.
    """
    H, W = image.shape[:2]
    scale = motion_scale or MOTION_SCALE * W
    picture = channel_image(name, image, scale, color)
    if name == "color":
        return picture
    text = title or name
    if name == "motion":
        size = min(H, W) // 5 + 1
        corner = None if color is None else color[-size:, -size:]
        picture[-size:, -size:] = motion_legend(scale, size, corner)
        return label(picture, f"{text}, rim {scale:.3g} px")
    limits = {"error": (0, LARGEST_ERROR), "depth": depth_limits(image)}
    least, largest = limits.get(name, (0, 1))
    colors = channel_image(name, np.linspace(least, largest, W)[None, :, None])
    return label(color_bar(picture, colors, (least, largest)), text)


def playback_speed(stream: FrameSource, camera: Camera, config: RenderConfig) -> dict[str, float]:
    """Return the speed at which this machine plays a stream: decode a frame, render its colour,
    copy it to the host.

    At most the first 30 frames are measured. The first one compiles kernels and is excluded if
    there are others.

    Args:
        stream: the file, with at least one frame.
        camera: any view.
        config: settings of the renderer, see `render_config`.

    Returns:
        ``fps``, frames per second at the size of `camera`, and the medians ``decode_ms`` and
        ``render_ms`` from which it is computed.

    Raises:
        ValueError: a broken packet.
    """
    times: list[tuple[float, float]] = []
    start = time.perf_counter()
    for _, gaussians in islice(play(stream), _MOST_TIMED_FRAMES):
        decoding = time.perf_counter() - start
        if not times:  # compiles kernels
            render(gaussians, camera, ("color",), config)
        start = time.perf_counter()
        to_uint8(render(gaussians, camera, ("color",), config)["color"])
        times.append((decoding, time.perf_counter() - start))
        start = time.perf_counter()
    decode, draw = np.median(times[1:] or times, axis=0)
    return {
        "fps": float(1 / (decode + draw)),
        "decode_ms": float(1e3 * decode),
        "render_ms": float(1e3 * draw),
    }


def available_channels(gaussians: Gaussians) -> tuple[str, ...]:
    """Return the channels of a stream's Gaussians: color, motion, depth, and channels of their
    attributes.
    """
    attributes = (
        name
        for name, attribute in attribute_channels().items()
        if getattr(gaussians, attribute.name) is not None
    )
    return ("color", "motion", "depth", *attributes)


def render(
    gaussians: Gaussians, camera: Camera, channels: Sequence[str], config: RenderConfig
) -> Arrays:
    """Return rendered channels as float32 arrays [H, W, C] by name."""
    image = rasterize(gaussians, camera, channels, config=config)
    return {name: np.array(image[name]) for name in channels}


def picture(
    stream: FrameSource,
    gaussians: Gaussians,
    camera: Camera,
    channel: str = "color",
    motion_scale: float = np.nan,
) -> np.ndarray:
    """Return a channel of a stream's Gaussians as the players show it, uint8 RGB [H, W, 3]: a
    `channel_image`, colour at the display exposure, motion over the grey image.

    Args:
        stream: the file, with the settings of the renderer.
        gaussians: of one of its frames.
        camera: any view.
        channel: such as ``motion``.
        motion_scale: speed of full saturation in pixels; needed for motion.
    """
    config = render_config(stream)
    values = render(gaussians, camera, (channel,), config)[channel]
    color = None
    if channel == "color":
        values = exposed(values, stream_exposure(stream))
    if channel == "motion":
        color = np.array(rasterize(gaussians, camera, ("color",), (0, 0, 0), config=config).color)
    return channel_image(channel, values, motion_scale, color)
