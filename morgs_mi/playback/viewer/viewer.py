"""A stream in the browser: play, scrub, orbit, show motion, compare with the recording, follow a running fit.

The page is viser's. It draws the Gaussians itself from their centres, covariances in half precision, and one colour and
opacity each, which makes orbiting smooth. "Exact image" shows the image of this package's renderer instead, which is
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

from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.png import png_bytes
from morgs_mi.playback.player import MOTION_SCALE, channel_image, render, render_config, stream_name
from morgs_mi.playback.streams import DRAWN
from morgs_mi.playback.viewer.access import checked_connections
from morgs_mi.playback.viewer.controls import FREE, Controls, control_table
from morgs_mi.playback.viewer.frame_cache import NO_TRAILS, FrameCache
from morgs_mi.playback.viewer.modes import available_modes, scale_text, sees_same, splat_values
from morgs_mi.playback.viewer.page_scene import PageScene
from morgs_mi.playback.viewer.page_view import PageCamera, page_view
from morgs_mi.playback.viewer.recorded import RecordedClip, seen_from, wipe

__all__ = ["Viewer", "ViewerConfig"]

_MOVING_MODES = ("motion", "confidence", "offset")
_NO_OFFSET = ". This frame stores no offset: set codec.offset in --config to store it in every frame but the first."
_PROVISIONAL = ". This frame is provisional: the first frame is still being fitted."
_NO_MOTION = ". The first frame has no motion."
_NOT_AT_CAMERA = ". Go to a camera to see its recorded image."
_NOT_RECORDED = ". There is no recorded image of this camera at this frame."
# Keys by command. W, A, S, D, Q, E and the arrows are viser's own keys for moving the camera.
_COMMANDS: tuple[tuple[str, Any, Callable[[Viewer, Any], None]], ...] = (
    ("Play or pause", "space", lambda viewer, _: viewer._controls.flip("playing")),
    ("Previous frame", "J", lambda viewer, _: viewer._move_frame(viewer._controls.frame.value - 1)),
    ("Next frame", "L", lambda viewer, _: viewer._move_frame(viewer._controls.frame.value + 1)),
    ("First frame", "home", lambda viewer, _: viewer._move_frame(0)),
    ("Last frame", "end", lambda viewer, _: viewer._move_frame(-1)),
    ("Next camera", "C", lambda viewer, client: viewer._page.go_to_next(client)),
    ("Next mode", "M", lambda viewer, _: viewer._controls.next_mode()),
    ("Exact image", "X", lambda viewer, _: viewer._controls.flip("exact")),
    ("Trajectories", "T", lambda viewer, _: viewer._controls.flip("trails")),
    ("Reset view", "R", lambda viewer, client: viewer._page.reset(client)),
)
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
        most_invalid: as for `open_stream`.

    Attributes:
        stream: the file, as it was opened.
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
        most_invalid: float = DRAWN,
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "Viewer(): expected viser, found none; install it with pip install 'morgs-mi[viewer]'."
            ) from error
        config = config or ViewerConfig()
        self._cache, self._trail, self._stopped = FrameCache(path, most_invalid), config.trail, Event()
        self._follow = config.follow
        if not self._cache.frames:
            raise ValueError(
                f"{self._cache.stream.path}: at least one frame was expected, got none; wait for the first."
            )
        self.stream = self._cache.stream
        self._cameras = self.stream.cameras
        self._config = render_config(self._cache.stream)
        self._recording = RecordedClip(self._cache, config.capture)
        self._shown: tuple[Any, ...] | None = None
        self._rendered: tuple[Any, np.ndarray] | None = None
        self._colored_for = self._cameras[0]  # camera that sees the colours of the Gaussians on the page
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
            self._server.stop()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._stopped.set()

    def _set_up_page(self) -> None:
        """Decode the first frame and set up the page."""
        server, cache = self._server, self._cache
        first = cache.at(cache.frames[0]).gaussians
        server.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False)
        page = self._page = PageCamera(server, self._cameras, first.numpy()["means"])
        self._scene = PageScene(server.scene, page.scale)
        self._scene.add_cameras(self._cameras, cache.stream.metadata.get("test_view"), page.go_to)
        table = control_table(len(cache.frames), available_modes(first), [camera.name for camera in self._cameras])
        controls = self._controls = Controls(server.gui, table)
        if (problem := self._recording.problem()) is not None:
            controls.disable_recorded(problem)
        controls.follow.value, self._mode = self._follow, controls.mode.value
        controls.reset.on_click(lambda event: page.reset(event.client))
        controls.screenshot.on_click(lambda event: self._requests.put(partial(self._send_screenshot, event.client)))
        controls.camera.on_update(self._choose_camera)
        for label, key, act in _COMMANDS:
            server.gui.add_command(label, hotkey=key).on_trigger(lambda event, act=act: act(self, event.client))

    def _choose_camera(self, event: Any) -> None:
        """Go to the camera that a client has chosen; the viewer itself also sets the control."""
        if event.client is not None and self._controls.camera.value != FREE:
            names = [camera.name for camera in self._cameras]
            self._page.go_to(event.client, names.index(self._controls.camera.value))

    def _move_frame(self, index: float) -> None:
        self._controls.go_to_frame(int(index), len(self._cache.frames))

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
        number, camera = self._page.number, self._page.camera
        if self._shown is not None and now - self._page.since < _REST:
            number = self._shown[-1]  # the camera still moves
        wanted = (frame, *controls.settings, number)
        if wanted == self._shown:
            return
        at = self._page.index()
        if self._shown is None or number != self._shown[-1]:
            controls.camera.value = FREE if at is None else self._cameras[at].name
        coded, share = self._cache.at(frame), 0.01 * controls.recorded.value
        recorded = None if at is None or not share else self._recorded_image(at, frame, camera)
        if controls.exact.value or recorded is not None:
            image = self._rendered_image(coded.gaussians, camera, (frame, controls.mode.value, number))
            self._scene.show_image(image if recorded is None else wipe(recorded, image, share))
        else:
            self._show_splats(coded, camera)
        self._scene.show_trails(*(self._cache.trails(frame, self._trail) if controls.trails.value else NO_TRAILS))
        self._scene.show_cameras(controls.cameras.value, at)
        missing = "" if not share or recorded is not None else _NOT_AT_CAMERA if at is None else _NOT_RECORDED
        controls.status.content = self._status(coded) + missing
        self._server.flush()
        self._shown = wanted

    def _status(self, coded: CodedFrame) -> str:
        """Return the frame, the number of Gaussians, and what the frame lacks."""
        own, mode = coded.gaussians, self._controls.mode.value
        lacks_offset, lacks_motion = mode == "offset" and own.offset is None, mode == "motion" and own.motion is None
        note = _NO_OFFSET if lacks_offset else _NO_MOTION if lacks_motion else ""
        note += _PROVISIONAL if self._cache.is_provisional else ""
        return f"Frame {coded.frame} of {self._cache.frames[-1]}, {len(own)} Gaussians{note}"

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

    def _show_splats(self, coded: CodedFrame, camera: Camera) -> None:
        mode, motion_scale = self._controls.mode.value, MOTION_SCALE * camera.width
        camera = self._colored_for = self._colored_for if sees_same(camera, self._colored_for, mode) else camera
        values = splat_values(coded.gaussians, camera, mode)
        self._scene.show_splats(coded.ids, coded.gaussians, values, mode, motion_scale)
        self._controls.show_scale(scale_text(mode, values, motion_scale))

    def _send_screenshot(self, client: Any) -> None:
        """Send the image of the renderer, as large as the page."""
        frame, mode = self._frame_at(int(self._controls.frame.value)), self._controls.mode.value
        camera = page_view(client.camera, self._page.scale)
        image = channel_image(mode, render(self._cache.at(frame).gaussians, camera, (mode,), self._config)[mode])
        name = f"{stream_name(self._cache.stream)}-frame{frame:04d}-{mode}.png"
        client.send_file_download(name, png_bytes(image), save_immediately=True)

    def _rendered_image(self, gaussians: Gaussians, camera: Camera, key: tuple[Any, ...]) -> np.ndarray:
        """Return the image of the renderer; it is rendered again when `key` changes."""
        mode = self._controls.mode.value
        if self._rendered is None or self._rendered[0] != key:
            self._rendered = (key, render(gaussians, camera, (mode,), self._config)[mode])
        values = self._rendered[1]
        self._controls.show_scale(scale_text(mode, values, MOTION_SCALE * camera.width))
        return channel_image(mode, values)

    def _recorded_image(self, view: int, frame: int, camera: Camera) -> np.ndarray | None:
        """Return the recorded image of a camera of the rig as the page sees it; None if there is none."""
        try:
            image = self._recording.at(view, frame)
        except (OSError, ValueError) as error:
            self._controls.disable_recorded(str(error))
            return None
        return None if image is None else seen_from(camera, self._cameras[view], image)
