"""A recording of two textured planes that move in front of others."""

import numpy as np

from tests.scenes import textured

COUNT = 4


def rig():
    """Return four small cameras."""
    return [camera.resized(200, 150) for camera in textured.rig(COUNT)]


def film(frames):
    """Return the clip of each camera."""
    planes = textured.textures()
    clips = []
    for camera in rig():
        still = textured.render(camera, planes)
        clips.append(
            [textured.render(camera, planes[:2], _moving(t), still) for t in range(frames)]
        )
    return clips


def _moving(t):
    """Return the places of the moving planes at frame t."""
    x = 0.9 * np.sin(0.21 * t)
    y = 0.6 * np.sin(0.33 * t + 0.5)
    return [
        ((x - 0.3, y - 0.6, 3.2), (0.5, 0, 0), (0, 0.5, 0)),
        ((0.1 - y, 0.5 * x, 2.6), (0.3, 0, 0), (0, 0.4, 0)),
    ]
