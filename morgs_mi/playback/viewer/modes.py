"""Colours of the Gaussians in each mode, as a camera sees them, with the same scales as the renderer's images."""

from __future__ import annotations

import numpy as np

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import colors_seen_from
from morgs_mi.playback.player import CHANNELS, OFFSET_SCALE, channel_image
from morgs_mi.playback.visualise import depth_range

__all__ = ["BACKGROUNDS", "MODES", "available_modes", "scale_text", "sees_same", "splat_values", "value_colors"]

_ATTRIBUTE_MODES = {row.channel: row for row in ATTRIBUTES if row.channel is not None}

_ROUNDING = 1e-4

MODES = tuple(channel for channel in CHANNELS if channel != "alpha")
"""All channels that can be shown, apart from alpha."""
BACKGROUNDS = dict.fromkeys(MODES, 0) | {"motion": 255, "offset": 255, "depth": 128}
"""Grey level behind translucent splats: the colour of no motion, confidence, offset or depth; black behind colours."""


def available_modes(gaussians: Gaussians) -> tuple[str, ...]:
    """Return the modes for which Gaussians have an attribute; motion, offset and depth always count."""
    missing = {mode for mode, row in _ATTRIBUTE_MODES.items() if getattr(gaussians, row.name) is None}
    return tuple(mode for mode in MODES if mode not in missing)


def sees_same(camera: Camera, other: Camera, mode: str) -> bool:
    """Return whether two cameras see the same colours of Gaussians in a mode, up to the rounding of a page's camera."""
    pairs = [(camera.position, other.position)]
    if mode != "color":  # which depends on the position only
        pairs += [(camera.viewmat[:3, :3], other.viewmat[:3, :3]), (camera.K, other.K)]
    return all(np.allclose(a, b, rtol=_ROUNDING, atol=_ROUNDING) for a, b in pairs)


def splat_values(gaussians: Gaussians, camera: Camera, mode: str) -> np.ndarray:
    """Return the values [N, C] that a mode shows of N Gaussians as a camera sees them, in the channel's units.

    Motion and offset are the first-order projections of the displacements; the offset is zero where none is stored.

    Raises:
        ValueError: `mode` is not one of `MODES`, or the Gaussians do not have its attribute.
    """
    if mode == "color":
        return colors_seen_from(gaussians, camera.position)
    raw = gaussians.numpy()
    if mode == "depth":
        return camera.project(raw["means"])[1][:, None]
    if mode == "offset" or (mode == "motion" and gaussians.motion is not None):
        displacements = raw.get(mode, np.zeros_like(raw["means"]))
        return np.einsum("nij,nj->ni", camera.projection_jacobian(raw["means"]), displacements)
    row = _ATTRIBUTE_MODES.get(mode)
    if row is None or getattr(gaussians, row.name) is None:
        raise ValueError(
            f"splat_values(): the mode must be one of {', '.join(MODES)} that the stream stores, got {mode!r}."
        )
    return np.asarray(getattr(gaussians, row.activated_name)).reshape(len(gaussians), -1)


def scale_text(mode: str, values: np.ndarray, motion_scale: float) -> str:
    """Return the meaning of a mode's colours; empty for colours.

    Args:
        mode: one of `MODES`.
        values: the values that are shown, in the channel's units; they determine the range of the depth.
        motion_scale: speed of full saturation in pixels, as for `channel_image`.
    """
    if mode == "color":
        return ""
    if mode in ("motion", "offset"):
        scale = motion_scale * (OFFSET_SCALE if mode == "offset" else 1)
        return f"Hue: direction on the screen; saturated: {scale:.3g} px per frame or more; white: no {mode}."
    if mode == "depth":
        near, far = depth_range(values)
        return f"Red: {near:.3g}, blue: {far:.3g} world units; linear in 1 / depth."
    return "Dark violet: 0, static; bright yellow: 1, moving." if mode == "confidence" else "Black: 0; white: 1."


def value_colors(mode: str, values: np.ndarray, motion_scale: float) -> np.ndarray:
    """Return the colours of values [N, C] of a mode, uint8 [N, 3]; `motion_scale` as for `channel_image`."""
    return channel_image(mode, values[:, None], motion_scale)[:, 0]
