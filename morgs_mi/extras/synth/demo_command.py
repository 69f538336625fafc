"""`morgs-mi demo`: a synthetic clip, its reconstruction and a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_next, print_result, print_table, progress
from morgs_mi.cli.settings import (
    Settings,
    optional,
    options,
    setting,
)
from morgs_mi.evaluate.tables import figure
from morgs_mi.extras.synth.demo import DemoConfig

_DEFAULT = DemoConfig()
# Titles and digits of the compared scores, by name.
_SCORES = {
    "psnr": ("PSNR, dB", 2),
    "ssim": ("SSIM", 4),
    "motion_error": ("flow error, px", 2),
    "motion_error_moving": ("moving, px", 2),
    "motion_error_still": ("still, px", 2),
}


@options
class Demo:
    """Synthesise a clip, reconstruct it with and without learned motion, and write figures and a
    report to OUT.

    It takes a few minutes. A clip that is in OUT already is used again if its settings are the
    same.
    """

    out: Positional[Path]
    """Folder for all results; those of an earlier demo are replaced."""
    scene: Annotated[str, arg(metavar="SCENE")] = _DEFAULT.scene
    """Name of a scene (spheres, arm, thin, flicker, random) or its Python file."""
    cameras: int | None = _DEFAULT.clip.cameras
    """Number of cameras, the held-out cam00 included."""
    frames: int = _DEFAULT.clip.frames
    """Number of frames per camera."""
    width: int = _DEFAULT.clip.width
    """Width of the images in pixels, even."""
    height: int = _DEFAULT.clip.height
    """Height of the images in pixels, even."""
    spp: int | None = _DEFAULT.clip.spp
    """Samples per pixel."""
    seed: Annotated[int | None, setting("seed", _DEFAULT.stream)] = None
    """Seed of the clip and the fit."""
    config: Annotated[Path | None, optional("FILE.toml")] = None
    """File with settings of the fit, as `morgs-mi fit --print-config` writes it."""

    def run(self) -> None:
        from morgs_mi.extras.synth.demo import run_demo

        settings = Settings(config=self.config, seed=self.seed)
        stream = settings.stream_config(_DEFAULT.stream)
        settings.check_methods(stream)
        names = ("cameras", "frames", "width", "height", "spp")
        clip = replace(_DEFAULT.clip, **{name: getattr(self, name) for name in names})
        config = replace(_DEFAULT, scene=self.scene, clip=clip, stream=stream)
        with progress() as report:
            result = run_demo(self.out, config, report)
        # A row for each fit: its mean scores over the frames that both have.
        frames = result["comparison"]["frames"]
        table = Table(
            title=f"held-out view, frames {f'{frames[0]} to {frames[-1]}' if frames else 'none'}"
        )
        for column in ("", *(title for title, _ in _SCORES.values())):
            table.add_column(column, justify="right" if column else "left")
        for name, title in (("full", "with motion"), ("plain", "without")):
            row = result["comparison"][name]
            cells = (figure(row[key], digits) for key, (_, digits) in _SCORES.items())
            table.add_row(title, *cells)
        print_table(table)
        full = result["full"]
        print_result(
            f"Held-out PSNR {figure(full['psnr']['first'], 2)} dB in the first frame, "
            f"{figure(full['psnr']['last'], 2)} dB in the last of {full['num_frames']}; "
            f"{figure(full['seconds']['per_later_frame'], 1)} s and "
            f"{figure(full['bytes']['per_residual'] / 1e6, 2)} MB per later frame; "
            f"{result['seconds']['total']:.0f} s in all."
        )
        print_result(
            f"Video and contact sheet: {self.out / 'side_by_side.mp4'}, "
            f"{self.out / 'contact_sheet.png'}"
        )
        print_result(f"All results: {self.out / 'report.json'}")
        print_next("view", self.out / "stream")
