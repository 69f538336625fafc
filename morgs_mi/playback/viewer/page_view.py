"""The camera of the pages: as a `Camera`, moved to a camera of the rig, and recognised there.

A page shows the scene `scale` times as large. Its camera has square pixels and a centred principal point.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera
from morgs_mi.playback.export.axes import up_direction
from morgs_mi.playback.export.paths import focus

__all__ = ["PageCamera", "camera_at", "field_of_view", "orientation", "page_view", "point_ahead"]

# Distance on the page between the first camera and the point that it looks at: half-precision covariances have three
# digits for splats down to 1/1000 of it, and it fits the page's near and far planes.
_DISTANCE = 10.0
# Distance on the page up to which it is at a camera: an error of a pixel or two at the distance of the scene.
_AT_CAMERA = 0.01
# Seconds for which a new page may report the camera of an empty scene, before it has the initial one.
_ARRIVAL = 3.0


class PageCamera:
    """Camera of the pages of a server; with several pages, the one that moved last determines it.

    The pages begin at the first camera of the rig, upright to the mean up direction.

    Args:
        server: viser's `ViserServer`.
        cameras: the rig.
        means: centres of the Gaussians [N, 3], world units.

    Attributes:
        scale: factor by which the pages show the scene larger.
        camera: the camera.
        number: number of times that it has changed.
        since: time of the last change, as of `time.monotonic`.
    """

    def __init__(self, server: Any, cameras: Sequence[Camera], means: np.ndarray) -> None:
        self._cameras, self._start, first = cameras, server.initial_camera, cameras[0]
        self._center, self._up = focus(cameras, means), up_direction(cameras)
        self.scale = _DISTANCE / max(float(np.linalg.norm(first.position - self._center)), 1e-12)
        self.camera, self.number, self.since = first, 0, 0.0
        server.scene.set_up_direction(self._up)
        self._start.up, self._start.position = self._up, self.scale * first.position
        self._start.look_at = self.scale * point_ahead(first, self._center)
        self._start.fov = 2 * float(np.arctan(0.5 * first.height / first.K[1, 1]))
        server.on_client_connect(self._watch)

    def index(self) -> int | None:
        """Return the index of the camera of the rig at which the page is; None if it is elsewhere."""
        return camera_at(self.camera, self._cameras, _AT_CAMERA / self.scale)

    def go_to(self, client: Any, index: int) -> None:
        """Move the page of a client to a camera of the rig; it shows all of the camera's image.

        The page is upright, as far as the camera is not rolled, and orbits around the point on the camera's axis at the
        depth of the scene's centre.
        """
        page, camera = client.camera, self._cameras[index]
        with client.atomic():
            page.up_direction = self._up
            page.position = self.scale * camera.position
            page.wxyz = orientation(camera)
            page.look_at = self.scale * point_ahead(camera, self._center)
            page.fov = field_of_view(camera, page.aspect)

    def go_to_next(self, client: Any) -> None:
        """Move the page of a client to the next camera of the rig."""
        at = self.index()
        self.go_to(client, 0 if at is None else (at + 1) % len(self._cameras))

    def reset(self, client: Any) -> None:
        """Move the page of a client to where it began."""
        start, page = self._start, client.camera
        with client.atomic():
            page.up_direction, page.position = start.up, start.position
            page.look_at, page.fov = start.look_at, start.fov

    def _watch(self, client: Any) -> None:
        arriving_until = time.monotonic() + _ARRIVAL

        def moved(_: Any) -> None:
            nonlocal arriving_until
            at_start = np.allclose(client.camera.position, self._start.position, atol=_AT_CAMERA)
            if at_start or time.monotonic() > arriving_until:
                arriving_until = 0.0
                self.camera = page_view(client.camera, self.scale)
                self.number, self.since = self.number + 1, time.monotonic()

        client.camera.on_update(moved)


def page_view(page: Any, scale: float) -> Camera:
    """Return the camera of a page (viser's `CameraHandle`) with the size of the page in pixels."""
    height = max(int(page.image_height), 1)
    width = max(round(height * page.aspect), 1)
    f = 0.5 * height / np.tan(0.5 * page.fov)
    R = Rotation.from_quat(page.wxyz, scalar_first=True).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ (np.asarray(page.position) / scale)
    K = np.array([[f, 0, 0.5 * width], [0, f, 0.5 * height], [0, 0, 1.0]])
    return Camera(K, viewmat, width, height, "page")


def orientation(camera: Camera) -> np.ndarray:
    """Return the rotation from the camera's axes to the world's as a quaternion [4], real part first."""
    R = np.asarray(camera.viewmat, np.float64)[:3, :3]
    return Rotation.from_matrix(R.T).as_quat(scalar_first=True)


def point_ahead(camera: Camera, center: np.ndarray) -> np.ndarray:
    """Return the point [3] on the camera's axis at the depth of `center` [3]."""
    axis = np.asarray(camera.viewmat, np.float64)[2, :3]
    return camera.position + axis * max((center - camera.position) @ axis, 1e-6)


def field_of_view(camera: Camera, aspect: float) -> float:
    """Return the vertical angle in radians at which a page of this aspect ratio shows all of a camera's image."""
    (fx, fy), (cx, cy) = np.diag(camera.K)[:2], camera.K[:2, 2]
    across, down = max(cx, camera.width - cx) / fx, max(cy, camera.height - cy) / fy
    return 2 * float(np.arctan(max(down, across / aspect)))


def camera_at(view: Camera, cameras: Sequence[Camera], tolerance: float) -> int | None:
    """Return the index of the camera at the position of a view, up to `tolerance` in world units; None if none is.

    Of several at the same position, it is the one with the most similar direction.
    """
    distances = [float(np.linalg.norm(camera.position - view.position)) for camera in cameras]
    near = [i for i, distance in enumerate(distances) if distance <= tolerance]
    return max(near, key=lambda i: float(np.sum(cameras[i].viewmat[:3, :3] * view.viewmat[:3, :3])), default=None)
