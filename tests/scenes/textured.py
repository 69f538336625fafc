"""Images of textured planes from known cameras, rendered exactly by homographies."""

from dataclasses import replace

import cv2
import numpy as np

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video
from tests.scenes.cameras import shift_principal_point

_TEXTURE = 512
# Corner, and the edges that span it; far planes first, as near ones occlude them.
_PLANES = (
    ((-4.0, -3.0, 6.0), (8.0, 0, 0), (0, 6.0, 0)),  # back wall
    ((-4.0, 1.5, 1.0), (8.0, 0, 0), (0, 0, 5.0)),  # floor (y points down)
    ((-1.8, -0.6, 4.5), (1.3, 0, 0.4), (0, 1.6, 0)),
    ((0.4, -0.9, 3.6), (1.2, 0, -0.5), (0, 1.7, 0.2)),
)


def rig(count=6, width=320, height=240, shift=0.0):
    """Return cameras on an arc in front of the planes, with principal points `shift` px off the
    centre.
    """
    cameras = []
    for i, angle in enumerate(np.linspace(-0.35, 0.35, count)):
        place = (4.0 * np.sin(angle), -0.5 + 0.5 * np.cos(5 * i), 4.2 - 4.0 * np.cos(angle))
        view = Camera.look_at(place, (0, 0, 4.2), (0, -1, 0), 60, width, height, f"cam{i}")
        cameras.append(shift_principal_point(view, shift, -0.5 * shift))
    return cameras


def write_capture(path):
    """Write and read six cameras with off-centre principal points and one frame, without points."""
    cameras = rig(shift=7)
    planes = textures()
    write_colmap(path / "sparse", cameras)
    for camera in cameras:
        write_video(path / f"{camera.name}.mkv", [render(camera, planes)], 30)
    return load_capture(path)


def with_cameras(capture, change):
    """Return the capture with the cameras that `change` returns for an index and a camera."""
    return capture.with_cameras([change(i, camera) for i, camera in enumerate(capture.cameras)])


def turned(camera, degrees):
    """Return the camera rotated about its optical axis."""
    c = np.cos(np.deg2rad(degrees))
    s = np.sin(np.deg2rad(degrees))
    return replace(
        camera,
        viewmat=np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        @ camera.viewmat,
    )


def textures():
    """Return one texture per plane, RGB uint8, with detail at several scales."""
    rng = np.random.default_rng(0)
    images = []
    for _ in _PLANES:
        octaves = [rng.uniform(0, 1, (n, n, 3)) for n in (16, 32, 64, 128)]
        sum_ = sum(
            cv2.resize(o, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_CUBIC) for o in octaves
        )
        images.append((255 * np.clip(sum_ / 3 - 0.1, 0, 1)).astype(np.uint8))
    return images


def render(camera, planes, places=_PLANES, background=None):
    """Return the image of the planes in a camera, RGB uint8 [H, W, 3], in front of a `background`
    image.
    """
    image = (
        np.zeros((camera.height, camera.width, 3), np.uint8)
        if background is None
        else background.copy()
    )
    R = camera.viewmat[:3, :3]
    t = camera.viewmat[:3, 3]
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are integers
    for (corner, across, down), texture in zip(places, planes, strict=True):
        plane = np.stack([R @ across, R @ down, R @ corner + t], axis=1) @ np.diag(
            [1 / _TEXTURE, 1 / _TEXTURE, 1]
        )
        H = np.linalg.inv(centre) @ camera.K @ plane @ centre
        # Rendered at twice the size and downscaled, against aliasing.
        double = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
        size = (2 * camera.width, 2 * camera.height)
        warped = cv2.warpPerspective(texture, double @ H, size, flags=cv2.INTER_LINEAR)
        cover = cv2.warpPerspective(
            np.full(texture.shape[:2], 255, np.uint8), double @ H, size, flags=cv2.INTER_NEAREST
        )
        shrink = (camera.width, camera.height)
        warped, cover = (
            cv2.resize(x, shrink, interpolation=cv2.INTER_AREA) for x in (warped, cover)
        )
        image[cover > 127] = warped[cover > 127]
    return image


def points(rng, count):
    """Return random points [count, 3] on the planes, and their colours in [0, 1]."""
    corners, across, down = (np.array(column) for column in zip(*_PLANES, strict=True))
    rows = rng.integers(0, len(corners), count)
    x, y = rng.uniform(0, 1, (2, count, 1))
    columns, lines = (
        np.minimum(_TEXTURE * place[:, 0], _TEXTURE - 1).astype(int) for place in (x, y)
    )
    return corners[rows] + x * across[rows] + y * down[rows], np.array(textures())[
        rows, lines, columns
    ] / 255


def distance_to_planes(points):
    """Return the distance of each point [n, 3] from the nearest of the planes (taken as infinite),
    world units.
    """
    distances = []
    for corner, across, down in _PLANES:
        normal = np.cross(across, down)
        distances.append(np.abs((points - corner) @ normal) / np.linalg.norm(normal))
    return np.min(distances, axis=0)
