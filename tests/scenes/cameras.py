"""Cameras that look at a scene: on a plane, an arc or a circle."""

from dataclasses import replace

import numpy as np

from morgs_mi import Camera

# Four origins in front of the scene.
QUAD = tuple((x, y, -3.5) for x in (-0.9, 0.9) for y in (-0.6, 0.6))


def arc(angles, radius, y=0.0):
    """Return origins on a horizontal arc in front of the scene, seen along +z at angle 0."""
    return [(radius * np.sin(a), y, -radius * np.cos(a)) for a in angles]


def circle(angles, radius=1.0, z=0.5):
    """Return origins on a circle about the z axis, at height z."""
    return [(radius * np.cos(a), radius * np.sin(a), z) for a in angles]


def look_at_cameras(
    origins,
    fov=50.0,
    width=64,
    height=48,
    names=None,
    *,
    target=(0.0, 0.0, 0.0),
    up=(0.0, -1.0, 0.0),
):
    """Return one camera per origin that looks at `target`, with the names cam0, cam1, ... unless
    `names` are given.
    """
    origins = list(origins)
    names = [f"cam{i}" for i in range(len(origins))] if names is None else names
    return [
        Camera.look_at(origin, target, up, fov, width, height, name)
        for origin, name in zip(origins, names, strict=True)
    ]


def shift_principal_point(camera, x, y):
    """Return the camera with its principal point shifted by (x, y) pixels."""
    return replace(camera, K=camera.K + np.array([[0, 0, x], [0, 0, y], [0, 0, 0]]))


def make_camera(width=21, height=18):
    """Return a camera of a size that no block divides, with an off-centre principal point and fx !=
    fy.
    """
    camera = Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, width, height)
    K = camera.K + np.array([[0, 0, 1.3], [0, 2.0, -0.7], [0, 0, 0]])
    return Camera(K, camera.viewmat, width, height)


def make_wide_camera():
    """Return a camera of several tiles; the last blocks extend beyond the image on both sides."""
    return Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 101, 75)


def make_sensor_camera():
    """Return `make_camera` with fx = fy, because Mitsuba's sensors have one focal length."""
    camera = make_camera()
    K = camera.K.copy()
    K[1, 1] = K[0, 0]
    return replace(camera, K=K)


def moved(cameras, origin):
    """Return cameras relative to a point of the world."""
    return [camera.relative_to(origin) for camera in cameras]
