"""The training cameras of a file of Gaussians, if they see the Gaussians.

Nothing in a `cameras.json` names its Gaussians. It may be of another scene in the same folder, or
of the same scene before it was moved or scaled.
"""

from __future__ import annotations

import logging
from pathlib import Path
from reprlib import repr as shortened

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import seen_points, with_near_planes
from morgs_mi.io.model_cameras import model_cameras
from morgs_mi.playback.default_rig import thinned

_log = logging.getLogger(__name__)

# Share of the Gaussians, weighted by opacity, that all cameras together see at least.
_LEAST_SEEN = 0.03
# Share that each camera sees at least, of the share of the camera that sees most.
_LEAST_RELATIVE = 0.02
# Extent of what a camera sees, in widths of its image: below, the scene is a dot.
_LEAST_EXTENT = 0.03


def trained_cameras(path: Path, gaussians: Gaussians) -> tuple[Path | None, tuple[Camera, ...]]:
    """Return the cameras with which a file of Gaussians was trained, and the file that has them.

    Cameras that do not see the Gaussians are left out with a warning.

    Args:
        path: the file.
        gaussians: its Gaussians.

    Returns:
        None and no cameras where no `cameras.json` belongs to the Gaussians.

    Raises:
        ValueError: an entry of the `cameras.json` is broken.
    """
    file, cameras = model_cameras(path)
    if not cameras or not len(gaussians):
        return None, ()
    some = thinned(gaussians)
    cameras = with_near_planes(cameras, some.numpy()["means"])
    visible = np.stack([_seen(some, camera) for camera in cameras])
    opacities = np.asarray(some.opacities, np.float64)
    weights = opacities / opacities.sum()
    share = visible.any(axis=0) @ weights
    if share < _LEAST_SEEN:
        _log.warning(
            "%s: its cameras see %.1f %% of the Gaussians of %s and are not used, as they seem to "
            "be of another scene; the cameras are a ring around the Gaussians instead.",
            file,
            100 * share,
            path.name,
        )
        return None, ()
    shares = visible @ weights
    good = shares >= _LEAST_RELATIVE * shares.max()
    if not good.all():
        names = [camera.name for camera, is_good in zip(cameras, good, strict=True) if not is_good]
        _log.warning(
            "%s: %d of %d cameras are left out, because they see next to nothing of the Gaussians "
            "of %s: %s.",
            file,
            len(names),
            len(cameras),
            path.name,
            shortened(names),
        )
    return file, tuple(cameras[i] for i in np.flatnonzero(good))


def _seen(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return which of N Gaussians a camera sees, bool [N]: none that are a dot in its image."""
    raw = gaussians.numpy()
    visible, pixels, depths = seen_points(camera, raw["means"])
    if not visible.any():
        return visible
    with np.errstate(all="ignore"):
        sizes = np.exp(raw["log_scales"][visible].max(axis=1, initial=-69))
        radii = camera.K[0, 0] * sizes / depths
        extent = np.ptp(pixels, axis=0).max() + 2 * np.median(radii)
    return visible & (extent >= _LEAST_EXTENT * camera.width)
