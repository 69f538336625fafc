"""A stream in the browser: play, scrub, orbit, see motion, follow a fit while it runs.

The page is viser's. It draws the Gaussians itself, so that orbiting is smooth, from centres, covariances in half
precision, one colour and opacity each; `exact` shows the picture of this package's renderer instead, drawn again
wherever the camera comes to rest. All decoding and drawing happens in the one thread that calls `run`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera
from morgs_mi.core.geometry import covariances
from morgs_mi.export.axes import up_direction
from morgs_mi.export.paths import focus
from morgs_mi.playback.player import channel_image, render, render_config
from morgs_mi.viewer.clip import Clip
from morgs_mi.viewer.modes import BACKGROUNDS, MODES, splat_colors

__all__ = ["Viewer", "ViewerConfig"]

# The first camera stands that far from what it looks at on the page: half-precision covariances keep three digits of
# splats down to 1/1000 of that distance, and the page's near and far planes fit.
_DISTANCE = 10.0
_HALF_MAX = 6e4
_NO_OFFSET = ". It holds no offset: fit with codec.offset = true (--config), and each frame but the first holds one."
_TICK, _LOOK_AGAIN, _REST = 0.01, 1.0, 0.2  # seconds


@dataclass(frozen=True)
class ViewerConfig:
    """Where the page is, and how it starts."""

    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone, 0.0.0.0 is everybody who can reach it."""
    port: int = 8080
    """Port; the next free one is taken."""
    trail: int = 10
    """Frames that a trajectory reaches back."""


class Viewer:
    """A page that shows a stream.

    Args:
        path: stream file, or the folder of a fit; it may still be written.
        config: address and how it starts.

    Attributes:
        url: where the page is.

    Raises:
        ImportError: viser is not installed.
        FileNotFoundError, ValueError: there is no stream, or none with a frame.
    """

    def __init__(self, path: str | Path, config: ViewerConfig | None = None) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "Viewer(): expected viser, found none; install it with pip install 'morgs-mi[viewer]'."
            ) from error
        config = config or ViewerConfig()
        self._clip, self._trail, self._stopped = Clip(path), config.trail, Event()
        if not self._clip.frames:
            raise ValueError(
                f"{self._clip.stream.path}: at least one frame was expected, got none; wait for the first."
            )
        first = self._clip.at(self._clip.frames[0]).gaussians
        cameras = self._clip.stream.cameras
        self._view = (0, 0.0, cameras[0])  # number of the view, since when, and what it is
        center = focus(cameras, first.numpy()["means"])
        self._scale = _DISTANCE / max(float(np.linalg.norm(cameras[0].position - center)), 1e-12)
        self._config = render_config(self._clip.stream)
        self._shown: tuple[Any, ...] | None = None
        self._splats: Any = None
        self._frame_time = time.monotonic()
        self._server = viser.ViserServer(config.host, config.port, label="morgs_mi", verbose=False)
        self.url = f"http://{config.host}:{self._server.get_port()}"
        self._modes = tuple(mode for mode in MODES if mode != "confidence" or first.logit_confidence is not None)
        self._build(center)

    def run(self) -> None:
        """Serve the page until `stop`, from the thread that may use Dr.Jit."""
        looked = time.monotonic()
        try:
            while not self._stopped.wait(_TICK):
                now = time.monotonic()
                try:
                    if now - looked > _LOOK_AGAIN:
                        looked = now
                        if self._clip.refresh():
                            self._grow()
                    if self._clip.frames:  # else begun anew just now
                        self._play(now)
                        self._show(now)
                except (ValueError, OSError) as error:  # damaged, or being replaced: say so, and look again
                    self._status.content, self._shown = str(error), None
                    self._stopped.wait(_LOOK_AGAIN)
        finally:
            self._server.stop()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._stopped.set()

    def _build(self, center: np.ndarray) -> None:
        server, camera, count = self._server, self._view[2], len(self._clip.frames)
        up = up_direction(self._clip.stream.cameras)
        server.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False)
        server.scene.set_up_direction(up)
        start = server.initial_camera
        start.up = up
        start.position, start.look_at = self._scale * camera.position, self._scale * self._facing(camera, center)
        start.fov = 2 * float(np.arctan(0.5 * camera.height / camera.K[1, 1]))
        gui = server.gui
        self._playing = gui.add_checkbox("Play", False)
        # A slider needs two ends; a stream of one frame has the second one without a picture of its own.
        self._slider = gui.add_slider("Frame", 0, max(count - 1, 1), 1, 0)
        self._speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
        self._mode = gui.add_dropdown("Mode", self._modes)
        self._trails = gui.add_checkbox("Trajectories", False)
        self._exact = gui.add_checkbox("Exact picture", False)
        self._follow = gui.add_checkbox("Follow the fit", False)
        self._status = gui.add_markdown("")
        server.on_client_connect(lambda client: client.camera.on_update(lambda _: self._look(client)))

    @staticmethod
    def _facing(camera: Camera, center: np.ndarray) -> np.ndarray:
        """Return the point on the camera's axis at the depth of the scene, so that the page starts with its view."""
        axis = np.asarray(camera.viewmat, np.float64)[2, :3]
        return camera.position + axis * max((center - camera.position) @ axis, 1e-6)

    def _look(self, client: Any) -> None:
        """Take note of where somebody looks from; the last who moved decides."""
        seen = client.camera
        height = max(int(seen.image_height), 1)
        width = max(round(height * seen.aspect), 1)
        f = 0.5 * height / np.tan(0.5 * seen.fov)
        R = Rotation.from_quat(seen.wxyz, scalar_first=True).as_matrix().T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ (np.asarray(seen.position) / self._scale)
        K = np.array([[f, 0, 0.5 * width], [0, f, 0.5 * height], [0, 0, 1.0]])
        self._view = (self._view[0] + 1, time.monotonic(), Camera(K, viewmat, width, height, "page"))

    def _grow(self) -> None:
        last = max(len(self._clip.frames) - 1, 1)
        self._slider.value = min(int(self._slider.value), last)
        self._slider.max = last
        self._shown = None  # how many there are is shown too, and a file begun anew has other frames

    def _play(self, now: float) -> None:
        step = 1 / (self._clip.stream.fps * self._speed.value)
        if not self._playing.value:
            self._frame_time = now
            last = len(self._clip.frames) - 1
            if self._follow.value and self._slider.value != last:
                self._slider.value = last
        elif now - self._frame_time >= step:
            # What is late is not caught up with: every frame is shown.
            self._frame_time = max(self._frame_time + step, now - step)
            self._slider.value = (int(self._slider.value) + 1) % len(self._clip.frames)

    def _show(self, now: float) -> None:
        """Send what changed, if anything did."""
        at = self._clip.frames[min(int(self._slider.value), len(self._clip.frames) - 1)]
        number, since, camera = self._view
        if self._shown is not None and now - since < _REST:
            number = self._shown[-1]  # it still moves
        wanted = (at, self._mode.value, self._trails.value, self._exact.value, number)
        if wanted == self._shown:
            return
        coded = self._clip.at(at)
        if self._exact.value:
            self._show_exact(coded.gaussians, camera)
        else:
            self._show_splats(coded.gaussians, camera)
        if self._splats is not None:
            self._splats.visible = not self._exact.value
        self._show_trails(at)
        missing = self._mode.value == "offset" and coded.gaussians.offset is None
        self._status.content = f"Frame {at} of {self._clip.frames[-1]}, {len(coded)} Gaussians{_NO_OFFSET * missing}"
        self._server.flush()
        self._shown = wanted

    def _show_splats(self, gaussians: Any, camera: Camera) -> None:
        behind = np.full((2, 2, 3), BACKGROUNDS[self._mode.value], np.uint8)
        self._server.scene.set_background_image(behind, format="png")
        splats = (
            self._scale * gaussians.numpy()["means"],
            np.clip(self._scale**2 * covariances(gaussians), -_HALF_MAX, _HALF_MAX),
            splat_colors(gaussians, camera, self._mode.value),
            np.asarray(gaussians.opacities)[:, None],
        )
        if self._splats is None:
            self._splats = self._server.scene.add_gaussian_splats("/splats", *splats)
        else:
            self._splats.set_gaussians(*splats)

    def _show_exact(self, gaussians: Any, camera: Camera) -> None:
        mode = self._mode.value
        image = render(gaussians, camera, (mode,), self._config)[mode]
        self._server.scene.set_background_image(channel_image(mode, image), format="png")

    def _show_trails(self, frame: int) -> None:
        if not self._trails.value:
            self._server.scene.remove_by_name("/trails")
            return
        lines, ages = self._clip.trails(frame, self._trail)
        if not len(lines):
            lines, ages = np.zeros((1, 2, 3)), np.ones(1)
        bright = (255 * (1 - 0.8 * ages)).astype(np.uint8)
        colors = np.broadcast_to(
            np.stack([bright, bright, np.full_like(bright, 40)], axis=-1)[:, None], (*lines.shape,)
        )
        self._server.scene.add_line_segments(
            "/trails", self._scale * lines, colors, thickness=1.5, thickness_units="screen"
        )
