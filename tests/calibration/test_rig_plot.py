"""The plot of the rig."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.calibration.rig_plot import draw_rig
from morgs_mi.core.camera import Camera
from tests.scenes.cameras import circle, look_at_cameras


def test_draw_rig__draws_cameras_at_their_positions() -> None:
    """Cameras on a line lie side by side seen from above; the held-out one is red."""
    cameras = [Camera.look_at((x, 0, 0), (x, 0, 5), (0, -1, 0), 60, 64, 48, "") for x in (-1.0, 0.0, 1.0)]
    points = np.array([[0.0, 0, 3], [1e6, 0, 0]])
    image = draw_rig(cameras, points, np.array([[0, 1.0, 0], [0, 1, 0]]), test_view=1).astype(int)
    above = image[:, :720]
    rows, columns = np.nonzero((above[..., 0] == 210) & (above[..., 1] == 60))
    others = np.nonzero((above[..., 0] == 40) & (above[..., 1] == 90))[1]
    assert abs(columns.mean() - 360) < 2
    assert others.min() < 200
    assert others.max() > 520
    green = np.argwhere((above == (0, 255, 0)).all(-1))
    assert len(green)
    assert green[:, 0].mean() < rows.min()  # ahead of the cameras, which face the top
    assert abs(green[:, 1].mean() - 360) < 2


@pytest.mark.parametrize("count", [1, 2, 8])
def test_draw_rig__draws_any_rig(count: int) -> None:
    cameras = look_at_cameras(circle(2 * np.pi * np.arange(count) / count, z=0), 60, up=(0, 0, 1))
    image = draw_rig(cameras, np.zeros((0, 3)), np.zeros((0, 3)))
    assert (image < 200).any()
