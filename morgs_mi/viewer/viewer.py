"""A stream in the browser: play, scrub, orbit, show motion, compare with the recording, follow a running fit.

The page is viser's. It draws the Gaussians itself from their centres, covariances in half precision, and one colour and
opacity each, so that orbiting is smooth. "Exact image" shows the image of this package's renderer instead, which is
rendered whenever the camera comes to rest. All decoding and rendering happens in the thread that calls `run`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.export.axes import up_direction
from morgs_mi.export.paths import focus
from morgs_mi.io.png import png_bytes
from morgs_mi.playback.player import (
    MOTION_SCALE,
    channel_image,
    fitted_capture,
    num_frames,
    open_stream_capture,
    render,
    render_config,
    stream_name,
)
from morgs_mi.viewer.access import checked_connections
from morgs_mi.viewer.arrow_keys import NEXT, PREVIOUS
from morgs_mi.viewer.controls import FREE, Controls
from morgs_mi.viewer.crop import crop_limits, is_in_box, is_shown
from morgs_mi.viewer.frame_cache import NO_TRAILS, FrameCache
from morgs_mi.viewer.legend import legend_html
from morgs_mi.viewer.modes import available_modes, sees_same, splat_values
from morgs_mi.viewer.page_scene import PageScene
from morgs_mi.viewer.page_view import camera_at, move_page, page_view, point_ahead
from morgs_mi.viewer.picking import blend_weights, description
from morgs_mi.viewer.recorded import RecordedImages, seen_from, wipe
from morgs_mi.viewer.turntable import Axis, Turntable

__all__ = ["Viewer", "ViewerConfig"]

# Distance on the page between the first camera and the point that it looks at: half-precision covariances have three
# digits for splats down to 1/1000 of it, and it fits the page's near and far planes.
_DISTANCE = 10.0
# Distance on the page up to which it is at a camera: an error of a pixel or two at the distance of the scene.
_AT_CAMERA = 0.01
_MOVING_MODES = ("motion", "confidence", "offset")
_NO_OFFSET = ". This frame stores no offset: set codec.offset in --config to store it in every frame but the first."
_NO_MOTION = ". The first frame has no motion."
_NOT_AT_CAMERA = ". Go to a camera to see its recorded image."
_NOT_RECORDED = ". There is no recorded image of this camera at this frame."
_ANY, _LOCAL = ("0.0.0.0", "::", ""), ("127.0.0.1", "::1", "localhost")
# In seconds: period of the loop, period of reading the file again, time without motion after which the camera rests.
_TICK, _REFRESH, _REST = 0.01, 1.0, 0.2
# Seconds for which a new page may report the camera of an empty scene, before it has the initial one.
_ARRIVAL = 3.0


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
    follow: bool = False
    """Show the newest frame while the file grows."""
    capture: Path | None = None
    """Folder of the capture with the recorded images; by default the one that was fitted."""


class Viewer:
    """Server of a page that shows a stream.

    Args:
        path: stream file, or the folder of a fit; it may still be written.
        config: address and initial settings.
        on_served: called as soon as a browser can open the page, which then loads while the first frame is decoded.

    Attributes:
        url: address of the page on this machine.
        is_public: whether other machines can reach it.

    Raises:
        ImportError: viser is not installed.
        FileNotFoundError, ValueError: there is no stream, or the stream has no frame.
    """

    def __init__(
        self,
        path: str | Path,
        config: ViewerConfig | None = None,
        on_served: Callable[[Viewer], None] = lambda viewer: None,
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "Viewer(): expected viser, found none; install it with pip install 'morgs-mi[viewer]'."
            ) from error
        config = config or ViewerConfig()
        self._cache, self._trail, self._stopped = FrameCache(path), config.trail, Event()
        self._follow = config.follow
        if not self._cache.frames:
            raise ValueError(
                f"{self._cache.stream.path}: at least one frame was expected, got none; wait for the first."
            )
        self._cameras = self._cache.stream.cameras
        self._view = (0, 0.0, self._cameras[0])  # number of the view, time of the last change, camera
        self._config = render_config(self._cache.stream)
        self._capture = config.capture
        self._recording: RecordedImages | None = None
        self._shown: tuple[Any, ...] | None = None
        self._rendered: tuple[Any, np.ndarray] | None = None
        self._colored_for = self._cameras[0]  # camera that sees the colours of the Gaussians on the page
        self._picked: int | None = None
        self._requests: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._frame_time = time.monotonic()
        ready = Event()
        with checked_connections((config.host, *config.allowed_names), ready):
            self._server = viser.ViserServer(config.host, config.port, label="morgs_mi", verbose=False)
        host = "localhost" if config.host in _ANY else config.host
        self.is_public = config.host not in _LOCAL
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"
        try:
            on_served(self)
            self._set_up_page()
        except BaseException:
            self._server.stop()
            raise
        ready.set()

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
                            self._controls.set_count(len(self._cache.frames))
                            self._shown = None  # the number of frames is shown, and a replaced file has other frames
                    while not self._requests.empty():
                        self._requests.get()()
                    if self._cache.frames:  # empty while the file is being replaced
                        self._play(now)
                        self._show(now)
                except (ValueError, OSError) as error:  # damaged or being replaced: show the message and try again
                    self._controls.status.content, self._shown = str(error), None
                    self._stopped.wait(_REFRESH)
        finally:
            self._turntable.turn(False)
            self._server.stop()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._stopped.set()

    def _set_up_page(self) -> None:
        """Decode the first frame and set up the page; it begins at the first camera, upright to the mean up."""
        server, camera = self._server, self._cameras[0]
        first = self._cache.at(self._cache.frames[0]).gaussians
        means = first.numpy()["means"]
        self._center, self._up = focus(self._cameras, means), up_direction(self._cameras)
        self._scale = _DISTANCE / max(float(np.linalg.norm(camera.position - self._center)), 1e-12)
        server.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False)
        server.scene.set_up_direction(self._up)
        start = server.initial_camera
        start.up, start.position = self._up, self._scale * camera.position
        start.look_at = self._scale * point_ahead(camera, self._center)
        start.fov = 2 * float(np.arctan(0.5 * camera.height / camera.K[1, 1]))
        self._scene = PageScene(server.scene, self._scale)
        self._scene.add_cameras(self._cameras, self._cache.stream.metadata.get("test_view"), self._go_to)
        self._turntable = Turntable(lambda: server.get_clients().values(), Axis(self._scale * self._center, self._up))
        self._controls = Controls(
            server.gui,
            len(self._cache.frames),
            available_modes(first),
            [camera.name for camera in self._cameras],
            crop_limits(means),
            self._missing_capture(),
        )
        self._controls.follow.value = self._follow
        self._mode = self._controls.mode.value
        self._connect()

    def _connect(self) -> None:
        """Connect the page's cameras, its buttons and its keys."""
        controls, gui = self._controls, self._server.gui
        self._server.on_client_connect(self._watch)
        controls.reset.on_click(lambda event: self._reset(event.client))
        controls.turntable.on_update(lambda _: self._turntable.turn(controls.turntable.value))
        controls.screenshot.on_click(lambda event: self._requests.put(partial(self._send_screenshot, event.client)))

        @controls.pick.on_update
        def _(_: Any) -> None:
            # Only while picking, because the page's pointer shows that the scene can be clicked.
            scene = self._server.scene
            if controls.pick.value:
                scene.on_click()(lambda event: self._requests.put(partial(self._pick, event.client, event.screen_pos)))
            else:
                scene.remove_click_callback()

        @controls.camera.on_update
        def _(event: Any) -> None:
            if event.client is not None and controls.camera.value != FREE:
                self._go_to(event.client, [camera.name for camera in self._cameras].index(controls.camera.value))

        def next_camera(client: Any) -> None:
            at = self._camera_index()
            self._go_to(client, 0 if at is None else (at + 1) % len(self._cameras))

        def next_mode(_: Any) -> None:
            options = controls.mode.options
            controls.mode.value = options[(options.index(controls.mode.value) + 1) % len(options)]

        def flip(box: Any) -> Callable[[Any], None]:
            return lambda _: setattr(box, "value", not box.value)

        def move(change: Callable[[int], int]) -> Callable[[Any], None]:
            return lambda _: self._move_frame(change)

        # W, A, S, D, Q, E and the arrows up and down are viser's own keys for moving the camera.
        keys: list[tuple[str, Any, Callable[[Any], None]]] = [
            ("Play or pause", "space", flip(controls.playing)),
            ("Previous frame", PREVIOUS, move(lambda index: index - 1)),
            ("Next frame", NEXT, move(lambda index: index + 1)),
            ("First frame", "home", move(lambda _: 0)),
            ("Last frame", "end", move(lambda _: len(self._cache.frames) - 1)),
            ("Next camera", "C", next_camera),
            ("Next mode", "M", next_mode),
            ("Exact image", "X", flip(controls.exact)),
            ("Trajectories", "T", flip(controls.trails)),
            ("Pick", "P", flip(controls.pick)),
            ("Turntable", "O", flip(controls.turntable)),
            ("Reset view", "R", self._reset),
        ]
        for label, key, act in keys:
            gui.add_command(label, hotkey=key).on_trigger(lambda event, act=act: act(event.client))

    def _watch(self, client: Any) -> None:
        arriving_until = time.monotonic() + _ARRIVAL

        def moved(_: Any) -> None:
            nonlocal arriving_until
            at_start = np.allclose(client.camera.position, self._server.initial_camera.position, atol=_AT_CAMERA)
            if at_start or time.monotonic() > arriving_until:
                arriving_until = 0.0
                self._set_view(client)

        client.camera.on_update(moved)

    def _move_frame(self, change: Callable[[int], int]) -> None:
        self._controls.playing.value = self._controls.follow.value = False
        self._controls.frame.value = change(int(self._controls.frame.value)) % max(len(self._cache.frames), 1)

    def _go_to(self, client: Any, index: int) -> None:
        move_page(client, self._cameras[index], self._center, self._up, self._scale)

    def _reset(self, client: Any) -> None:
        start, page = self._server.initial_camera, client.camera
        with client.atomic():
            page.up_direction, page.position, page.look_at, page.fov = (
                start.up,
                start.position,
                start.look_at,
                start.fov,
            )

    def _set_view(self, client: Any) -> None:
        """Store the camera of a client; with several clients, the one that moved last determines the view."""
        self._view = (self._view[0] + 1, time.monotonic(), page_view(client.camera, self._scale))

    def _camera_index(self) -> int | None:
        """Return the index of the camera at which the page is."""
        return camera_at(self._view[2], self._cameras, _AT_CAMERA / self._scale)

    def _play(self, now: float) -> None:
        controls = self._controls
        step = 1 / (self._cache.stream.fps * controls.speed.value)
        if not controls.playing.value:
            self._frame_time = now
            last = len(self._cache.frames) - 1
            if controls.follow.value and controls.frame.value != last:
                controls.frame.value = last
        elif now - self._frame_time >= step:
            # Delays are not caught up: every frame is shown.
            self._frame_time = max(self._frame_time + step, now - step)
            controls.frame.value = (int(controls.frame.value) + 1) % len(self._cache.frames)

    def _show(self, now: float) -> None:
        """Send the frame to the page if the frame, a setting or the view has changed."""
        self._choose_moving_frame()
        controls = self._controls
        frame = self._frame_at(int(controls.frame.value))
        number, since, camera = self._view
        if self._shown is not None and now - since < _REST:
            number = self._shown[-1]  # the camera still moves
        wanted = (frame, *controls.settings, number)
        if wanted == self._shown:
            return
        at = self._camera_index()
        if self._shown is None or number != self._shown[-1]:
            controls.camera.value = FREE if at is None else self._cameras[at].name
        coded, share = self._cache.at(frame), 0.01 * controls.recorded.value
        ids, gaussians = self._cropped(coded)
        turning = controls.turntable.value  # no image is rendered until the camera comes to rest
        recorded = None if at is None or not share or turning else self._recorded_image(at, frame, camera)
        if (controls.exact.value and not turning) or recorded is not None:
            self._show_image(gaussians, camera, recorded, (frame, *controls.render_settings, number))
        else:
            self._show_splats(ids, gaussians, camera)
        lines, ages = self._cache.trails(frame, self._trail) if controls.trails.value else NO_TRAILS
        inside = is_in_box(lines[:, 1], controls.open_crop_box)
        self._scene.show_trails(lines[inside], ages[inside])
        self._scene.show_cameras(controls.cameras.value, at)
        self._scene.show_box(controls.crop_box if controls.is_cropped else None)
        self._show_picked(coded)
        missing = "" if not share or recorded is not None else _NOT_AT_CAMERA if at is None else _NOT_RECORDED
        controls.status.content = self._status(coded, len(ids)) + missing
        self._server.flush()
        self._shown = wanted

    def _status(self, coded: CodedFrame, shown: int) -> str:
        """Return the frame, the number of Gaussians of which `shown` are not cropped, and what the frame lacks."""
        own, mode = coded.gaussians, self._controls.mode.value
        count = f"{shown}" if shown == len(own) else f"{shown} of {len(own)}"
        lacks_offset, lacks_motion = mode == "offset" and own.offset is None, mode == "motion" and own.motion is None
        note = _NO_OFFSET if lacks_offset else _NO_MOTION if lacks_motion else ""
        return f"Frame {coded.frame} of {self._cache.frames[-1]}, {count} Gaussians{note}"

    def _frame_at(self, index: int) -> int:
        return self._cache.frames[min(index, len(self._cache.frames) - 1)]

    def _choose_moving_frame(self) -> None:
        """Go to a frame with motion if a mode that shows motion has just been chosen: the first frame has none."""
        controls = self._controls
        if controls.mode.value == self._mode:
            return
        self._mode = controls.mode.value
        if self._mode in _MOVING_MODES:
            moving = self._cache.first_moving(self._frame_at(int(controls.frame.value)))
            controls.frame.value = self._cache.frames.index(moving)

    def _cropped(self, coded: CodedFrame) -> tuple[np.ndarray, Gaussians]:
        """Return the numbers [N] of the Gaussians that are shown, and those Gaussians."""
        controls = self._controls
        if not controls.is_cropped and controls.opacity.value == 0:
            return coded.ids, coded.gaussians
        shown = is_shown(coded.gaussians, controls.opacity.value, controls.open_crop_box)
        return coded.ids[shown], coded.gaussians.select(shown)

    def _show_splats(self, ids: np.ndarray, gaussians: Gaussians, camera: Camera) -> None:
        mode, motion_scale = self._controls.mode.value, MOTION_SCALE * camera.width
        camera = self._colored_for = self._colored_for if sees_same(camera, self._colored_for, mode) else camera
        values = splat_values(gaussians, camera, mode)
        self._scene.show_splats(ids, gaussians, values, mode, motion_scale)
        self._controls.show_legend(legend_html(mode, values, motion_scale))

    def _show_picked(self, coded: CodedFrame) -> None:
        """Show the attributes, the path and a label of the picked Gaussian, if there is one."""
        picked = self._picked if self._controls.pick.value else None
        if picked is None:
            self._controls.show_picked("")
            self._scene.show_picked(np.zeros((0, 3)), None, "")
            return
        self._controls.show_picked(description(coded, picked))
        position = coded.gaussians.numpy()["means"][coded.ids == picked]
        path = self._cache.path(picked, coded.frame, self._trail)
        self._scene.show_picked(path, position[0] if len(position) else None, str(picked))

    def _pick(self, client: Any, place: tuple[float, float]) -> None:
        """Pick the Gaussian that the renderer blends with the largest weight at a place of a page, from 0 to 1."""
        camera = page_view(client.camera, self._scale)
        size = np.array([camera.width, camera.height])
        column, row = np.minimum((np.array(place) * size).astype(int), size - 1)
        ids, gaussians = self._cropped(self._cache.at(self._frame_at(int(self._controls.frame.value))))
        weights = blend_weights(gaussians, camera, column, row, self._config)
        self._picked = int(ids[np.argmax(weights)]) if weights.any() else None
        self._shown = None

    def _send_screenshot(self, client: Any) -> None:
        """Send the image of the renderer, as large as the page."""
        frame, mode = self._frame_at(int(self._controls.frame.value)), self._controls.mode.value
        _, gaussians = self._cropped(self._cache.at(frame))
        camera = page_view(client.camera, self._scale)
        image = channel_image(mode, render(gaussians, camera, (mode,), self._config)[mode])
        name = f"{stream_name(self._cache.stream)}-frame{frame:04d}-{mode}.png"
        client.send_file_download(name, png_bytes(image), save_immediately=True)

    def _show_image(
        self, gaussians: Gaussians, camera: Camera, recorded: np.ndarray | None, key: tuple[Any, ...]
    ) -> None:
        """Show the image of the renderer, and the recorded image beside it; `key` determines the render."""
        mode = self._controls.mode.value
        if self._rendered is None or self._rendered[0] != key:
            self._rendered = (key, render(gaussians, camera, (mode,), self._config)[mode])
        values = self._rendered[1]
        image = channel_image(mode, values)
        self._scene.show_image(
            image if recorded is None else wipe(recorded, image, 0.01 * self._controls.recorded.value)
        )
        self._controls.show_legend(legend_html(mode, values, MOTION_SCALE * camera.width))

    def _recorded_image(self, view: int, frame: int, camera: Camera) -> np.ndarray | None:
        """Return the recorded image of a camera of the rig as the page sees it; None if there is none."""
        try:
            if self._recording is None or frame >= self._recording.num_frames:  # that of a live fit grows
                self._recording = RecordedImages(self._open_capture())
            image = self._recording.at(view, frame)
        except (OSError, ValueError) as error:
            self._controls.disable_recorded(str(error))
            return None
        return None if image is None else seen_from(camera, self._cameras[view], image)

    def _open_capture(self) -> Capture:
        stream = self._cache.stream
        count = max(num_frames(stream), self._cache.frames[-1] + 1)
        return open_stream_capture(stream, self._capture, list(range(count)))

    def _missing_capture(self) -> str | None:
        """Return why there are no recorded images, without opening them; None if there are."""
        try:
            path = Path(self._capture or fitted_capture(self._cache.stream))
        except (OSError, ValueError) as error:
            return str(error)
        return None if path.is_dir() else f"{path}: expected the capture, found none; pass its folder (--capture)."
