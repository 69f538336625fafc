"""`morgs-mi render` with the option --insert."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from morgs_mi.cli.render import Render, RenderedImages
from morgs_mi.cli.settings import optional, options
from morgs_mi.platform.checks import require

if TYPE_CHECKING:
    from morgs_mi.codec.frame_source import FrameSource
    from morgs_mi.core.camera import Camera


@options
class RenderWithScene(Render):
    """Render a stream or a file of Gaussians into a video, EXR files or PNG files, for one camera
    or along a path.
    """

    insert: Annotated[Path | None, optional("FILE")] = None
    """Mitsuba scene whose objects stand among the Gaussians: FILE.xml, or FILE.py with a function
    build(frame, time) that returns the entries of a scene. Without emitters it is lit by the
    stream.
    """
    at: Annotated[tuple[int, ...] | None, optional("FRAME ...", "(default: all)")] = None
    """Frames to render with an inserted scene."""
    samples: Annotated[int, arg(metavar="INT")] = 16
    """Samples per pixel of an inserted scene."""
    shadows: bool = True
    """Whether an inserted scene throws shadows on the stream."""

    light: Literal["probe", "traced"] = "probe"
    """Light of an inserted scene: an environment map at its middle, or rays traced through the
    Gaussians, for their shadows and reflections."""

    def run(self) -> None:
        if self.insert is None:
            require(
                self.at is None, "--at", "expected an inserted scene", "none", "add --insert FILE"
            )
        else:
            require(
                self.camera not in (None, "all"),
                "--insert",
                "expected one camera",
                "none",
                "add --camera CAMERA",
            )
            require(
                self.background != "transparent",
                "--insert",
                "expected a background behind the Gaussians",
                "--background transparent",
                "leave one out",
            )
        super().run()

    def images(
        self, stream: FrameSource, view: Camera, channels: Sequence[str] | None, single: bool
    ) -> tuple[RenderedImages, int]:
        from morgs_mi.extras.light.insert import (
            InsertConfig,
            inserted_channels,
            load_insert,
            render_inserted,
            selected,
        )
        from morgs_mi.playback.export.clips import frame_numbers

        if self.insert is None:
            return super().images(stream, view, channels, single)
        frames = frame_numbers(stream) if self.at is None else selected(stream, self.at)
        channels = channels or inserted_channels(stream)
        config = InsertConfig(self.samples, self.shadows, self.light)
        build = load_insert(self.insert)
        return render_inserted(stream, view, build, frames, channels, config), len(frames)
