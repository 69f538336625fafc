"""Panoramas of Gaussians in the equirectangular projection, for one eye or both.

A pixel (u, v) of a panorama with W columns and H rows looks to the longitude lambda = 2 pi (u / W -
1/2) and the latitude phi = pi (1/2 - v / H): in the axes of its camera (x right, y down, z
forward), along

    d = (cos phi sin lambda, -sin phi, cos phi cos lambda).

Every pixel has rays of its own through the Gaussians (`SplatRays`), so there is no seam, and
nothing is approximated at the poles. The rays have no low-pass filter; a pixel is the mean of a
grid of rays.

For two eyes at a distance b, the ray of longitude lambda starts at -b/2 and +b/2 times (cos lambda,
0, -sin lambda), to the left and to the right of where it looks (omnidirectional stereo). The left
eye's panorama is above the right eye's.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import check_number
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import check_memory
from morgs_mi.core.rig import up_direction
from morgs_mi.playback.export.clips import flight_views
from morgs_mi.playback.export.paths import CameraPath
from morgs_mi.playback.stream_header import render_config
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.surfaces.splat_rays import SplatRays

# Rays that are traced at a time.
_MOST_RAYS = 2**20
# Bytes of a pixel of the result with a copy, and of a ray.
_PIXEL_BYTES = 24
_RAY_BYTES = 200


def panorama(
    gaussians: Gaussians,
    camera: Camera,
    width: int = 2048,
    stereo: float = 0.0,
    config: RenderConfig | None = None,
    samples: int = 2,
) -> np.ndarray:
    """Return the colour all around a camera, display-referred float32 [width / 2, width, 3].

    Args:
        gaussians: N Gaussians.
        camera: the position and the axes of the panorama; it looks along the middle of the image.
        width: number of columns, even.
        stereo: distance of the eyes, world units; then the result has [width, width, 3], the left
            eye above the right.
        config: cut-offs.
        samples: rays of a pixel along each side.

    Raises:
        ValueError: `width` is not even and positive, `stereo` is negative, or a Gaussian is not
            finite.
    """
    _check_size(width, stereo, samples)
    height = width // 2
    eyes = (-0.5, 0.5) if stereo else (0.0,)
    if not len(gaussians):
        return np.zeros((len(eyes) * height, width, 3), np.float32)
    rays = SplatRays(gaussians, config)
    to_world = np.linalg.inv(np.asarray(camera.viewmat, np.float64))[:3]
    rows = max(1, _MOST_RAYS // (width * samples**2))
    size = (width, height, samples)
    strips = [np.arange(start, min(start + rows, height)) for start in range(0, height, rows)]
    return np.concatenate(
        [_strip(rays, to_world, eye * stereo, size, strip) for eye in eyes for strip in strips]
    )


def _check_size(width: int, stereo: float, samples: int) -> None:
    """Raise `ValueError` if the size or the distance of the eyes is out of range."""
    check_number("panorama()", "stereo", stereo, "[0, inf)")
    if width < 2 or width % 2:
        raise ValueError(
            f"panorama(): `width` must be even and at least 2, got {width}; it is twice the height."
        )
    pixels = (2 if stereo else 1) * (width // 2) * width
    strip = max(_MOST_RAYS, width * samples**2)
    check_memory(
        "panorama()",
        _PIXEL_BYTES * pixels + _RAY_BYTES * strip,
        f"`width={width}`",
        "make it smaller",
    )


def _strip(
    rays: SplatRays,
    to_world: np.ndarray,
    shift: float,
    size: tuple[int, int, int],
    rows: np.ndarray,
) -> np.ndarray:
    """Return rows of a panorama [R, W, 3] of an eye that is `shift` to the right."""
    width, _, samples = size
    longitude, latitude = _angles(size, rows)
    origins, directions = _rays_of_eye(longitude, latitude, shift)
    directions = (directions @ to_world[:, :3].T).reshape(-1, 3)
    origins = (origins @ to_world[:, :3].T + to_world[:, 3]).reshape(-1, 3)
    color, _ = rays.trace(
        mi.Ray3f(mi.Point3f(np.float32(origins.T)), mi.Vector3f(np.float32(directions.T)))
    )
    values = np.array(dr.ravel(color)).reshape(len(rows), width, samples**2, 3)
    return values.mean(axis=2)


def _angles(size: tuple[int, int, int], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the longitudes and the latitudes [R, W, S, S] of the samples of rows of a panorama."""
    width, height, samples = size
    offsets = (np.arange(samples) + 0.5) / samples
    longitude = 2 * np.pi * ((np.arange(width)[:, None] + offsets) / width - 0.5)
    latitude = np.pi * (0.5 - (rows[:, None] + offsets) / height)
    longitude, latitude = np.broadcast_arrays(
        longitude[None, :, None, :], latitude[:, None, :, None]
    )
    return longitude, latitude


def _rays_of_eye(
    longitude: np.ndarray, latitude: np.ndarray, shift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the origins and the directions [..., 3] of rays in the axes of the camera."""
    sine = np.sin(longitude)
    cosine = np.cos(longitude)
    zero = np.zeros_like(longitude)
    level = np.stack([sine, zero, cosine], axis=-1)
    right = np.stack([cosine, zero, -sine], axis=-1)
    down = np.array([0, 1, 0])
    return shift * right, np.cos(latitude)[..., None] * level - np.sin(latitude)[..., None] * down


def panoramas(
    stream: FrameSource, view: Camera | CameraPath, width: int = 2048, stereo: float = 0.0
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Render the panoramas of a stream at a camera, or of the images of `flight` along a path, with
    a level horizon.

    Args:
        stream: the file.
        view: the camera or the path; its direction is the middle of the image.
        width: number of columns, even.
        stereo: distance of the eyes, world units; 0: one eye.

    Yields:
        (frame, images) as `render_stream`, with the channel ``color``.

    Raises:
        ValueError: as `panorama`, or a packet is broken.
    """
    up = up_direction(stream.cameras)
    config = render_config(stream)
    if isinstance(view, CameraPath):
        views = flight_views(stream, view)
    else:
        views = ((frame, gaussians, view) for frame, gaussians in play(stream))
    for i, gaussians, camera in views:
        yield i, {"color": panorama(gaussians, levelled(camera, up), width, stereo, config)}


def levelled(camera: Camera, up: np.ndarray) -> Camera:
    """Return a camera at the same position that looks to the same side with a level horizon; `up`
    [3] is up.

    The side of a camera that looks straight down is where the top of its image is.
    """
    _, down, forward = np.asarray(camera.viewmat, np.float64)[:3, :3]
    direction = np.cross(np.cross(up, forward), up)
    if np.linalg.norm(direction) < 1e-3:
        direction = down if forward @ up > 0 else -down
    return Camera.look_at(
        camera.position,
        camera.position + direction,
        up,
        90,
        camera.width,
        camera.height,
        camera.name,
    )
