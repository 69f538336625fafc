"""A capture in the layout of Dynamic 3D Gaussians with small annotations of TAPVid-3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.scenes import captures as layouts
from tests.scenes.captures import COUNT, rig

STEP = 0.03
# Three points that move along x, in world units [P, T, 3].
STARTS = np.array([(0.0, 0, 0), (0.1, 0.1, 0), (-0.1, 0, 0.1)])
PATHS = STARTS[:, None] + STEP * np.arange(COUNT)[:, None] * (1, 0, 0)
VISIBLE = np.array([[1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 1]], bool)
QUERIES = VISIBLE.argmax(1)


def annotated(path: Path, names: tuple[str, ...]) -> Path:
    """Write the capture and annotations NAME_CAMERA.npz of some of its cameras 2, 1 and 10."""
    layouts.dynamic3dgs(path)
    for camera in rig(("2", "1", "10"), shift=3):
        if camera.name in names:
            V = np.asarray(camera.viewmat)
            K = camera.K
            local = PATHS @ V[:3, :3].T + V[:3, 3]
            at_query = PATHS[np.arange(len(PATHS)), QUERIES]
            np.savez(
                path / f"{path.name}_{camera.name}.npz",
                tracks_XYZ=local.transpose(1, 0, 2),
                visibility=VISIBLE.T,
                queries_xyt=np.column_stack([camera.project(at_query)[0], QUERIES]),
                fx_fy_cx_cy=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
                images_jpeg_bytes=np.array([b"jpeg"] * COUNT, object),
            )
    return path
