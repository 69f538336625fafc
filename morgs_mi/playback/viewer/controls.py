"""The controls of the page, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

__all__ = ["FREE", "Control", "Controls", "control_table"]

FREE = "free"
"""Name of a view that is not a camera's."""
_KEYS = (
    "Keys, after a click on the scene: **Space** play, **J** and **L** frame, **M** mode, **C** camera, **R** reset "
    "view, **Ctrl+K** all."
)


@dataclass(frozen=True)
class Control:
    """A control of the page.

    Attributes:
        name: attribute of `Controls`.
        kind: last part of the name of viser's function, such as ``slider``.
        arguments, options: of that function.
        draws: whether the value determines what the page draws.
    """

    name: str
    kind: str
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    draws: bool


def _control(name: str, kind: str, *arguments: Any, draws: bool = False, **options: Any) -> Control:
    return Control(name, kind, arguments, options, draws)


def control_table(count: int, modes: Sequence[str], cameras: Sequence[str]) -> tuple[Control, ...]:
    """Return the controls of a page from top to bottom.

    Args:
        count: number of frames.
        modes: names of the modes.
        cameras: names of the cameras.
    """
    newest = "Show the newest frame while the file grows."
    at_rest = "Image of the renderer, whenever the camera comes to rest."
    paths = "Paths of the Gaussians that moved farthest."
    share = "Percentage of the width that shows the recorded image of the camera."
    return (
        _control("status", "markdown", ""),
        _control("playing", "checkbox", "Play", False),
        # A slider needs two ends; for a stream of one frame both show the same image.
        _control("frame", "slider", "Frame", 0, max(count - 1, 1), 1, 0),
        _control("speed", "slider", "Speed", 0.1, 4.0, 0.1, 1.0),
        _control("follow", "checkbox", "Follow the fit", False, hint=newest),
        _control("mode", "dropdown", "Mode", tuple(modes), draws=True),
        _control("scale", "markdown", "", visible=False),
        _control("exact", "checkbox", "Exact image", False, draws=True, hint=at_rest),
        _control("trails", "checkbox", "Trajectories", False, draws=True, hint=paths),
        _control("camera", "dropdown", "Go to camera", (FREE, *cameras)),
        _control("recorded", "slider", "Recorded %", 0, 100, 1, 0, draws=True, hint=share),
        _control("problem", "markdown", "", visible=False),
        _control("cameras", "checkbox", "Show cameras", False, draws=True, hint="Click a camera to go to it."),
        _control("reset", "button", "Reset view"),
        _control("screenshot", "button", "Screenshot", hint="Download the exact image of this view."),
        _control("keys", "markdown", _KEYS),
    )


class Controls(SimpleNamespace):
    """The controls of a page, each viser's handle under the name of its row in the table.

    Args:
        gui: viser's `GuiApi`.
        table: the controls.
    """

    def __init__(self, gui: Any, table: Sequence[Control]) -> None:
        super().__init__()
        for row in table:
            setattr(self, row.name, getattr(gui, f"add_{row.kind}")(*row.arguments, **row.options))
        self._drawing = [row.name for row in table if row.draws]

    @property
    def settings(self) -> tuple[Any, ...]:
        """Values that determine what the page draws, apart from the frame."""
        return tuple(getattr(self, name).value for name in self._drawing)

    def set_count(self, count: int) -> None:
        """Set the number of frames."""
        last = max(count - 1, 1)
        self.frame.value = min(int(self.frame.value), last)
        self.frame.max = last

    def flip(self, name: str) -> None:
        """Change a checkbox."""
        box = getattr(self, name)
        box.value = not box.value

    def next_mode(self) -> None:
        """Select the next mode."""
        options = self.mode.options
        self.mode.value = options[(options.index(self.mode.value) + 1) % len(options)]

    def go_to_frame(self, index: int, count: int) -> None:
        """Stop playing, and go to a frame out of `count`, counted from either end."""
        self.playing.value = self.follow.value = False
        self.frame.value = index % max(count, 1)

    def disable_recorded(self, problem: str) -> None:
        """Disable the recorded images and report why they cannot be shown."""
        self.recorded.value, self.recorded.disabled = 0, True
        self.problem.content, self.problem.visible = f"No recorded images: {problem}", True

    def show_scale(self, text: str) -> None:
        """Show the meaning of a mode's colours, or none if the text is empty."""
        if self.scale.content != text:
            self.scale.content, self.scale.visible = text, bool(text)
