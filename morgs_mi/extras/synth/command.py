"""`morgs-mi synth`: a synthetic capture."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from morgs_mi.cli.console import print_next, print_result, progress
from morgs_mi.cli.settings import (
    Flag,
    options,
)
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.platform.checks import quantity


@options
class Synth:
    """Path-trace a moving scene into a multi-view capture with exact ground truth."""

    scene: Positional[str]
    """Name of a scene (spheres, arm, thin, flicker, random), or path of a Python file with a
    function build(seed).
    """
    out: Positional[Path]
    """New folder for the capture."""
    config: Annotated[SynthConfig, arg(name=""), OmitArgPrefixes] = field(
        default_factory=SynthConfig
    )
    overwrite: Flag = False
    """Replace an earlier synthetic capture in OUT."""

    def run(self) -> None:
        from morgs_mi.extras.synth.synthesize import synthesize

        with progress() as report:
            synthesize(
                self.scene,
                self.out,
                self.config,
                overwrite=self.overwrite,
                progress=lambda done, total: report("Path-tracing", done, total),
            )
        config = self.config
        images = "PNG files and videos" if config.lossless else "videos"
        cameras = len(list((self.out / "truth").glob("cam*")))
        size = f"{quantity(config.frames, 'frame')} of {config.width}x{config.height}"
        print_result(f"{self.out}: {cameras} cameras, {size} as {images}, with ground truth.")
        print_next("fit", self.out, self.out.with_name(f"{self.out.name}-fit"))
