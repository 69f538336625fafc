"""The controls of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["FREE", "Controls"]

FREE = "free"
"""Name of a view that is not a camera's."""
_KEYS = (
    "Keys, after a click on the scene: **Space** play, **←** and **→** frame, **M** mode, **C** camera, **R** reset "
    "view, **Ctrl+K** all."
)


class Controls:
    """The controls of the page, and what they are set to.

    Args:
        gui: viser's `GuiApi`.
        count: number of frames.
        modes: names of the modes.
        cameras: names of the cameras.
        limits: corners [2, 3] of the largest crop box, and the steps [3].
        no_recording: why there are no recorded images; None if there are.
    """

    def __init__(
        self,
        gui: Any,
        count: int,
        modes: Sequence[str],
        cameras: Sequence[str],
        limits: tuple[np.ndarray, np.ndarray],
        no_recording: str | None,
    ) -> None:
        self.status = gui.add_markdown("")
        self.playing = gui.add_checkbox("Play", False)
        # A slider needs two ends; for a stream of one frame both show the same image.
        self.frame = gui.add_slider("Frame", 0, max(count - 1, 1), 1, 0)
        self.speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
        self.follow = gui.add_checkbox("Follow the fit", False, hint="Show the newest frame while the file grows.")
        self.mode = gui.add_dropdown("Mode", tuple(modes))
        self.legend = gui.add_html("", visible=False)
        self.exact = gui.add_checkbox(
            "Exact image", False, hint="Image of the renderer, whenever the camera comes to rest."
        )
        self.trails = gui.add_checkbox("Trajectories", False, hint="Paths of the Gaussians that moved farthest.")
        self.pick = gui.add_checkbox("Pick", False, hint="Click a Gaussian for its attributes and its path.")
        self.picked = gui.add_markdown("", visible=False)
        with gui.add_folder("View"):
            self.camera = gui.add_dropdown("Go to camera", (FREE, *cameras), initial_value=FREE)
            self.recorded = gui.add_slider(
                "Recorded %",
                0,
                100,
                1,
                0,
                hint="Percentage of the width that shows the recorded image of the camera.",
            )
            self.problem = gui.add_markdown("", visible=False)
            self.cameras = gui.add_checkbox("Show cameras", False, hint="Click a camera to go to it.")
            self.turntable = gui.add_checkbox("Turntable", False, hint="Orbit around the scene's centre.")
            self.reset = gui.add_button("Reset view")
            self.screenshot = gui.add_button("Screenshot", hint="Download the exact image of this view.")
        with gui.add_folder("Crop", expand_by_default=False):
            self.opacity = gui.add_slider(
                "Opacity", 0.0, 1.0, 0.01, 0.0, hint="Gaussians with a lower opacity are hidden."
            )
            ranges = np.stack([*limits[0], limits[1]], axis=1)
            self.box = [
                self._add_range(gui, axis, *values.tolist()) for axis, values in zip("xyz", ranges, strict=True)
            ]
            gui.add_button("Show all").on_click(lambda _: self.show_all())
        gui.add_markdown(_KEYS)
        if no_recording is not None:
            self.disable_recorded(no_recording)

    @property
    def render_settings(self) -> tuple[Any, ...]:
        """The settings that determine the image of the renderer."""
        return tuple(handle.value for handle in (self.mode, self.opacity, *self.box))

    @property
    def settings(self) -> tuple[Any, ...]:
        """All settings that determine what the page draws."""
        others = (self.exact, self.recorded, self.trails, self.pick, self.turntable, self.cameras)
        return (*self.render_settings, *(handle.value for handle in others))

    @property
    def is_cropped(self) -> bool:
        """Whether the crop box is smaller than its limits."""
        return any(handle.value != (handle.min, handle.max) for handle in self.box)

    @property
    def crop_box(self) -> np.ndarray:
        """Corners [2, 3] of the crop box."""
        return np.transpose([handle.value for handle in self.box])

    @property
    def open_crop_box(self) -> np.ndarray:
        """Corners [2, 3] of the crop box, infinite where they are at its limits."""
        limits = np.transpose([(handle.min, handle.max) for handle in self.box])
        return np.where(self.crop_box == limits, [[-np.inf], [np.inf]], self.crop_box)

    def set_count(self, count: int) -> None:
        """Set the number of frames."""
        last = max(count - 1, 1)
        self.frame.value = min(int(self.frame.value), last)
        self.frame.max = last

    def disable_recorded(self, problem: str) -> None:
        """Disable the recorded images and report why they cannot be shown."""
        self.recorded.value, self.recorded.disabled = 0, True
        self.problem.content, self.problem.visible = f"No recorded images: {problem}", True

    def show_legend(self, html: str) -> None:
        """Show a legend, or none if it is empty."""
        if self.legend.content != html:
            self.legend.content = html
        if self.legend.visible != bool(html):
            self.legend.visible = bool(html)

    def show_picked(self, text: str) -> None:
        """Show the attributes of the picked Gaussian, or none if the text is empty."""
        self.picked.content, self.picked.visible = text, bool(text)

    def show_all(self) -> None:
        """Undo the crop."""
        self.opacity.value = 0.0
        for handle in self.box:
            handle.value = (handle.min, handle.max)

    @staticmethod
    def _add_range(gui: Any, axis: str, low: float, high: float, step: float) -> Any:
        hint = f"World units along {axis}; an end of the slider is no limit."
        low, high = (round(end, 6) for end in (low, high))
        return gui.add_multi_slider(axis, low, high, step, (low, high), hint=hint)
