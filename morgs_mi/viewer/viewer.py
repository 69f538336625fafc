"""A stream in the browser: play, scrub, orbit, show motion, follow a running fit.

The page is viser's. It draws the Gaussians itself from their centres, covariances in half precision, and one colour and
opacity each, so that orbiting is smooth. "Exact image" shows the image of this package's renderer instead, which is
rendered whenever the camera comes to rest. All decoding and rendering happens in the thread that calls `run`.
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
from morgs_mi.viewer.access import checked_connections
from morgs_mi.viewer.frame_cache import FrameCache
from morgs_mi.viewer.modes import BACKGROUNDS, available_modes, splat_colors

__all__ = ["Viewer", "ViewerConfig"]

# Distance on the page between the first camera and the point that it looks at: half-precision covariances have three
# digits for splats down to 1/1000 of it, and it fits the page's near and far planes.
_DISTANCE = 10.0
_HALF_MAX = 6e4
_NO_OFFSET = ". This frame stores no offset: set codec.offset in --config to store it in every frame but the first."
_ANY, _LOCAL = ("0.0.0.0", "::", ""), ("127.0.0.1", "::1", "localhost")
# In seconds: period of the loop, period of reading the file again, time without motion after which the camera rests.
_TICK, _REFRESH, _REST = 0.01, 1.0, 0.2


@dataclass(frozen=True)
class ViewerConfig:
    """Address and initial settings of the page."""

    host: str = "127.0.0.1"
    """Address of the server; the default serves this machine only, 0.0.0.0 all machines that can reach it."""
    port: int = 8080
    """Port of the server; the next free one if it is taken."""
    allowed_names: tuple[str, ...] = ()
    """Names under which browsers may open the page, besides localhost, HOST and addresses in digits."""
    trail: int = 10
    """Length of the trajectories, in frames."""


class Viewer:
    """Server of a page that shows a stream.

    Args:
        path: stream file, or the folder of a fit; it may still be written.
        config: address and initial settings.

    Attributes:
        url: address of the page on this machine.
        is_public: whether other machines can reach it.

    Raises:
        ImportError: viser is not installed.
        FileNotFoundError, ValueError: there is no stream, or the stream has no frame.
    """

    def __init__(self, path: str | Path, config: ViewerConfig | None = None) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "Viewer(): expected viser, found none; install it with pip install 'morgs-mi[viewer]'."
            ) from error
        config = config or ViewerConfig()
        self._cache, self._trail, self._stopped = FrameCache(path), config.trail, Event()
        if not self._cache.frames:
            raise ValueError(
                f"{self._cache.stream.path}: at least one frame was expected, got none; wait for the first."
            )
        first = self._cache.at(self._cache.frames[0]).gaussians
        cameras = self._cache.stream.cameras
        self._view = (0, 0.0, cameras[0])  # number of the view, time of the last change, camera
        center = focus(cameras, first.numpy()["means"])
        self._scale = _DISTANCE / max(float(np.linalg.norm(cameras[0].position - center)), 1e-12)
        self._config = render_config(self._cache.stream)
        self._shown: tuple[Any, ...] | None = None
        self._splats: Any = None
        self._frame_time = time.monotonic()
        with checked_connections((config.host, *config.allowed_names)):
            self._server = viser.ViserServer(config.host, config.port, label="morgs_mi", verbose=False)
        host = "localhost" if config.host in _ANY else config.host
        self.is_public = config.host not in _LOCAL
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"
        self._modes = available_modes(first)
        self._build(center)

    def run(self) -> None:
        """Serve the page until `stop` is called, from the only thread that uses Dr.Jit."""
        refreshed = time.monotonic()
        try:
            while not self._stopped.wait(_TICK):
                now = time.monotonic()
                try:
                    if now - refreshed > _REFRESH:
                        refreshed = now
                        if self._cache.refresh():
                            self._update_slider()
                    if self._cache.frames:  # empty while the file is being replaced
                        self._play(now)
                        self._show(now)
                except (ValueError, OSError) as error:  # damaged or being replaced: show the message and try again
                    self._status.content, self._shown = str(error), None
                    self._stopped.wait(_REFRESH)
        finally:
            self._server.stop()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._stopped.set()

    def _build(self, center: np.ndarray) -> None:
        server, camera, count = self._server, self._view[2], len(self._cache.frames)
        up = up_direction(self._cache.stream.cameras)
        server.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False)
        server.scene.set_up_direction(up)
        start = server.initial_camera
        start.up = up
        start.position, start.look_at = self._scale * camera.position, self._scale * self._look_at(camera, center)
        start.fov = 2 * float(np.arctan(0.5 * camera.height / camera.K[1, 1]))
        gui = server.gui
        self._playing = gui.add_checkbox("Play", False)
        # A slider needs two ends; for a stream of one frame both show the same image.
        self._slider = gui.add_slider("Frame", 0, max(count - 1, 1), 1, 0)
        self._speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
        self._mode = gui.add_dropdown("Mode", self._modes)
        self._trails = gui.add_checkbox("Trajectories", False)
        self._exact = gui.add_checkbox("Exact image", False)
        self._follow = gui.add_checkbox("Follow the fit", False)
        self._status = gui.add_markdown("")
        server.on_client_connect(self._watch)

    def _watch(self, client: Any) -> None:
        client.camera.on_update(lambda _: self._set_view(client))

    @staticmethod
    def _look_at(camera: Camera, center: np.ndarray) -> np.ndarray:
        """Return the point on the camera's axis at the depth of the scene, so that the page starts with its view."""
        axis = np.asarray(camera.viewmat, np.float64)[2, :3]
        return camera.position + axis * max((center - camera.position) @ axis, 1e-6)

    def _set_view(self, client: Any) -> None:
        """Store the camera of a client; with several clients, the one that moved last determines the view."""
        page = client.camera
        height = max(int(page.image_height), 1)
        width = max(round(height * page.aspect), 1)
        f = 0.5 * height / np.tan(0.5 * page.fov)
        R = Rotation.from_quat(page.wxyz, scalar_first=True).as_matrix().T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ (np.asarray(page.position) / self._scale)
        K = np.array([[f, 0, 0.5 * width], [0, f, 0.5 * height], [0, 0, 1.0]])
        self._view = (self._view[0] + 1, time.monotonic(), Camera(K, viewmat, width, height, "page"))

    def _update_slider(self) -> None:
        last = max(len(self._cache.frames) - 1, 1)
        self._slider.value = min(int(self._slider.value), last)
        self._slider.max = last
        self._shown = None  # the number of frames is shown too, and a replaced file has other frames

    def _play(self, now: float) -> None:
        step = 1 / (self._cache.stream.fps * self._speed.value)
        if not self._playing.value:
            self._frame_time = now
            last = len(self._cache.frames) - 1
            if self._follow.value and self._slider.value != last:
                self._slider.value = last
        elif now - self._frame_time >= step:
            # Delays are not caught up: every frame is shown.
            self._frame_time = max(self._frame_time + step, now - step)
            self._slider.value = (int(self._slider.value) + 1) % len(self._cache.frames)

    def _show(self, now: float) -> None:
        """Send the frame to the page if the frame, a setting or the view has changed."""
        frame = self._cache.frames[min(int(self._slider.value), len(self._cache.frames) - 1)]
        number, since, camera = self._view
        if self._shown is not None and now - since < _REST:
            number = self._shown[-1]  # the camera still moves
        wanted = (frame, self._mode.value, self._trails.value, self._exact.value, number)
        if wanted == self._shown:
            return
        coded = self._cache.at(frame)
        if self._exact.value:
            self._show_exact(coded.gaussians, camera)
        else:
            self._show_splats(coded.gaussians, camera)
        if self._splats is not None:
            self._splats.visible = not self._exact.value
        self._show_trails(frame)
        missing = self._mode.value == "offset" and coded.gaussians.offset is None
        self._status.content = (
            f"Frame {frame} of {self._cache.frames[-1]}, {len(coded)} Gaussians{_NO_OFFSET * missing}"
        )
        self._server.flush()
        self._shown = wanted

    def _show_splats(self, gaussians: Any, camera: Camera) -> None:
        background = np.full((2, 2, 3), BACKGROUNDS[self._mode.value], np.uint8)
        self._server.scene.set_background_image(background, format="png")
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
        lines, ages = self._cache.trails(frame, self._trail)
        if not len(lines):
            lines, ages = np.zeros((1, 2, 3)), np.ones(1)
        level = (255 * (1 - 0.8 * ages)).astype(np.uint8)
        colors = np.broadcast_to(np.stack([level, level, np.full_like(level, 40)], axis=-1)[:, None], lines.shape)
        self._server.scene.add_line_segments(
            "/trails", self._scale * lines, colors, thickness=1.5, thickness_units="screen"
        )
