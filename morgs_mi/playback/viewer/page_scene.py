"""The scene of a page: Gaussians or an image behind them, trajectories, the cameras of the rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances
from morgs_mi.playback.viewer.modes import BACKGROUNDS, value_colors
from morgs_mi.playback.viewer.page_view import orientation
from morgs_mi.playback.viewer.splat_chunks import SplatChunks, packed_splats

__all__ = ["PageScene"]

_HALF_MAX = 6e4
# Size of a camera on the page.
_FRUSTUM = 0.4
_CAMERA, _HELD_OUT = (90, 170, 255), (255, 160, 0)


class PageScene:
    """The scene of a page.

    Args:
        scene: viser's `SceneApi`.
        scale: factor by which the page shows the scene larger.
    """

    def __init__(self, scene: Any, scale: float) -> None:
        self._scene, self._scale = scene, scale
        self._splats = SplatChunks(scene)
        self._background: int | None = None
        self._cameras: list[tuple[Any, Any]] = []

    def show_splats(
        self, ids: np.ndarray, gaussians: Gaussians, values: np.ndarray, mode: str, motion_scale: float
    ) -> None:
        """Show Gaussians with numbers `ids` [N] in the colours of a mode; arguments as for `value_colors`."""
        if self._background != BACKGROUNDS[mode]:
            self._background = BACKGROUNDS[mode]
            self._scene.set_background_image(np.full((2, 2, 3), self._background, np.uint8), format="png")
        splats = packed_splats(
            self._scale * gaussians.numpy()["means"],
            np.clip(self._scale**2 * covariances(gaussians), -_HALF_MAX, _HALF_MAX),
            value_colors(mode, values, motion_scale),
            np.asarray(gaussians.opacities),
        )
        self._splats.show(ids, splats)
        self._splats.set_visible(True)

    def show_image(self, image: np.ndarray) -> None:
        """Show an image [H, W, 3] in place of the Gaussians."""
        self._scene.set_background_image(image, format="png")
        self._background = None
        self._splats.set_visible(False)

    def show_trails(self, lines: np.ndarray, ages: np.ndarray) -> None:
        """Show trails, see `FrameCache.trails`."""
        if not len(lines):
            self._scene.remove_by_name("/trails")
            return
        level = (255 * (1 - 0.8 * ages)).astype(np.uint8)
        colors = np.stack([level, level, np.full_like(level, 40)], axis=-1)[:, None]
        colors = np.broadcast_to(colors, lines.shape)
        self._scene.add_line_segments("/trails", self._scale * lines, colors, thickness=1.5, thickness_units="screen")

    def add_cameras(self, cameras: Sequence[Camera], test_view: Any, go_to: Callable[[Any, int], None]) -> None:
        """Add the cameras with their names, hidden; `go_to` is called with (client, index) when one is clicked."""
        held_out = test_view if isinstance(test_view, list) else [test_view]  # streams before 0.3 have one index
        for index, camera in enumerate(cameras):
            position = self._scale * camera.position
            frustum = self._scene.add_camera_frustum(
                f"/cameras/{index}",
                2 * float(np.arctan(0.5 * camera.height / camera.K[1, 1])),
                camera.width * camera.K[1, 1] / (camera.height * camera.K[0, 0]),
                scale=_FRUSTUM,
                thickness=2,
                thickness_units="screen",
                color=_HELD_OUT if index in held_out else _CAMERA,
                wxyz=orientation(camera),
                position=position,
                visible=False,
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(lambda event, index=index: go_to(event.client, index))
            name = f"{camera.name} (held out)" if index in held_out else camera.name
            label = self._scene.add_label(f"/names/{index}", name, position=position, visible=False)
            self._cameras.append((frustum, label))

    def show_cameras(self, visible: bool, at: int | None) -> None:
        """Show or hide the cameras; the one at which the page is, `at`, is always hidden."""
        for index, nodes in enumerate(self._cameras):
            for node in nodes:
                node.visible = visible and index != at
