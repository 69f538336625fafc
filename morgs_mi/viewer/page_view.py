"""The camera of a page: as a `Camera`, moved to a camera of the rig, and recognised there.

The page shows the scene `scale` times as large. Its camera has square pixels and a centred principal point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera

__all__ = ["camera_at", "field_of_view", "move_page", "orientation", "page_view", "point_ahead"]


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


def move_page(client: Any, camera: Camera, center: np.ndarray, up: np.ndarray, scale: float) -> None:
    """Move the camera of a client to a camera of the rig, so that the page shows all of its image.

    Args:
        client: viser's `ClientHandle`.
        camera: the camera.
        center: centre of the scene [3]; the page orbits around the point on the camera's axis at its depth.
        up: up direction of the page [3]. The page is upright in it, as far as the camera is not rolled.
        scale: of the page.
    """
    page = client.camera
    with client.atomic():
        page.up_direction = up
        page.position = scale * camera.position
        page.wxyz = orientation(camera)
        page.look_at = scale * point_ahead(camera, center)
        page.fov = field_of_view(camera, page.aspect)


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
