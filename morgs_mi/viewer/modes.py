"""What colour a Gaussian gets in each mode, as seen by a camera; the same scales as in the renderer's pictures."""

from __future__ import annotations

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import colors_seen_from
from morgs_mi.playback.player import OFFSET_SCALE
from morgs_mi.playback.visualise import confidence_image, depth_image, motion_image, to_uint8

__all__ = ["BACKGROUNDS", "FULL_SPEED", "MODES", "splat_colors"]

MODES = ("color", "motion", "confidence", "offset", "depth")
# Behind splats that let light through: nothing, no motion, no confidence, no offset, no depth.
BACKGROUNDS = {"color": 0, "motion": 255, "confidence": 0, "offset": 255, "depth": 128}
# Of the picture's width per frame: the speed of full saturation, as in `channel_image`.
FULL_SPEED = {"motion": 0.03, "offset": 0.03 * OFFSET_SCALE}


def splat_colors(gaussians: Gaussians, camera: Camera, mode: str) -> np.ndarray:
    """Return the colours of N Gaussians as a camera sees them, uint8 [N, 3].

    Motion is what it is on the camera's screen, by the first-order projection of the displacement; so is the offset,
    none where nothing is known of it.

    Raises:
        ValueError: another mode than one of `MODES`, or one that the Gaussians carry nothing for.
    """
    if mode == "color":
        return to_uint8(colors_seen_from(gaussians, camera.position)[:, None])[:, 0]
    raw, view = gaussians.numpy(), np.asarray(camera.viewmat, np.float64)
    x, y, z = (raw["means"] @ view[:3, :3].T + view[:3, 3]).T
    if mode == "depth":
        return depth_image(z[:, None])[:, 0]
    if mode == "offset" or (mode == "motion" and gaussians.motion is not None):
        dx, dy, dz = (raw.get(mode, np.zeros_like(raw["means"])) @ view[:3, :3].T).T
        safe = np.where(z > camera.near, z, np.inf)  # what lies behind does not move on the screen
        screen = np.stack([camera.K[0, 0] * (dx - x / safe * dz) / safe, camera.K[1, 1] * (dy - y / safe * dz) / safe])
        return motion_image(screen.T[:, None], FULL_SPEED[mode] * camera.width)[:, 0]
    if mode == "confidence" and gaussians.confidence is not None:
        return confidence_image(np.asarray(gaussians.confidence)[:, None])[:, 0]
    raise ValueError(f"splat_colors(): the mode must be one of {', '.join(MODES)} that the stream holds, got {mode!r}.")
