"""`morgs-mi synth`, `info` and `calibrate`: what comes in."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import Positional, arg

from morgs_mi.calibration.calibrate import CalibrateConfig
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.cli.console import OUT, progress, say, warn

__all__ = ["Calibrate", "Info", "Synth"]


@dataclass(frozen=True)
class Synth:
    """Path-trace a moving scene into a multi-view capture with exact ground truth."""

    scene: Positional[str]
    """Name of a scene (spheres, arm, thin, flicker) or the path of its Python file."""
    out: Positional[Path]
    """Folder to make."""
    cameras: int = 10
    """Number of cameras; cam00 is the one to hold out."""
    frames: int = 12
    """Number of frames per camera."""
    width: int = 320
    """Of the images in pixels, even."""
    height: int = 240
    """Of the images in pixels, even."""
    spp: int = 16
    """Samples per pixel; 16 leaves noise at 42 dB."""
    noise: float = 0.0
    """Standard deviation of the sensor's noise, of white; 0.01, 2.5 grey levels, is that of a camera indoors."""
    fps: float = 30.0
    """Frames per second."""
    lossless: bool = False
    """Also write the frames as PNG files."""
    seed: int = 0
    """Of textures, sampling noise and the choice of points."""
    overwrite: bool = False
    """Replace an earlier capture."""

    def run(self) -> None:
        from morgs_mi.synth.synthesize import synthesize

        with progress() as report:
            synthesize(
                self.scene,
                self.out,
                num_cameras=self.cameras,
                num_frames=self.frames,
                width=self.width,
                height=self.height,
                spp=self.spp,
                noise=self.noise,
                fps=self.fps,
                lossless=self.lossless,
                seed=self.seed,
                overwrite=self.overwrite,
                progress=lambda done, total: report("Path-tracing", done, total),
            )
        say(f"{self.out}: {self.cameras} cameras, {self.frames} frames of {self.width}x{self.height}.")


@dataclass(frozen=True)
class Info:
    """Say what a capture holds: layout, cameras, sizes, frames, points, and whether the poses fit the pictures."""

    capture: Positional[Path]
    """Folder of the capture."""
    plot: Path | None = None
    """Picture of the rig, .png or .jpg."""
    check: bool = True
    """Compare the poses with what the views of the first frame have in common."""
    reading: Annotated[ReadConfig, arg(name="")] = field(default_factory=ReadConfig)

    def run(self) -> None:
        from morgs_mi.calibration.rig_check import check_rig, match_capture, triangulate_points
        from morgs_mi.calibration.rig_plot import write_rig
        from morgs_mi.capture.capture import load_capture

        capture, found = load_capture(self.capture, reading=self.reading), None
        origin = "" if len(capture.points) else "without points"
        if self.check:
            with progress() as report:
                common = match_capture(capture, lambda done, total: report("Matching views", done, total))
            found = check_rig(capture, common)
            if origin:
                capture = triangulate_points(capture, common)
                origin += f" ({len(capture.points)} can be triangulated)"
        table = Table(title=f"{self.capture}: {capture.layout}", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for column in ("", "camera", "size", "focal, px", "centre, px", "seen", "use", "matches", "error, px"):
            table.add_column(column, no_wrap=True)
        for index, (camera, mask) in enumerate(zip(capture.cameras, capture.masks, strict=True)):
            K = camera.K
            table.add_row(
                str(index),
                camera.name,
                f"{camera.width}x{camera.height}",
                f"{K[0, 0]:.1f}" if f"{K[0, 0]:.1f}" == f"{K[1, 1]:.1f}" else f"{K[0, 0]:.1f} {K[1, 1]:.1f}",
                f"{K[0, 2]:.1f} {K[1, 2]:.1f}",
                "100 %" if mask is None else f"{100 * mask.mean():.0f} %",
                "test" if index == capture.test_view else "train",
                str(found.camera_matches[index]) if found else "-",
                f"{found.camera_errors[index]:.2f}" if found and found.camera_matches[index] else "-",
            )
        OUT.print(table)
        points = origin or f"{len(capture.points)} points"
        truth = "with ground truth" if capture.truth else "without ground truth"
        say(f"{capture.num_frames} frames at {capture.fps:g} fps, {points}, {truth}.")
        if found:
            error = f"median {found.error:.2f} px over " if found.matches else ""
            say(f"Reprojection check: {error}{found.matches} matches in {found.pairs} pairs; {found.advice}")
        if fit := capture.colors:
            changes = zip(capture.names, fit.before, fit.after, fit.samples, strict=True)
            table = ", ".join(
                f"{name} {a:.1f} -> {b:.1f} ({n} points)" if n else f"{name} -" for name, a, b, n in changes
            )
            say(f"Colours towards {capture.names[fit.reference]}, dE2000 before -> after: {table}.")
        if self.plot is not None:
            write_rig(self.plot, capture)
            say(f"The rig: {self.plot}")


@dataclass(frozen=True)
class Calibrate:
    """Find the cameras of a folder of clips with COLMAP, and write FOLDER/sparse/0."""

    folder: Positional[Path]
    """Folder of videos, or of a folder of images per camera."""
    config: Annotated[CalibrateConfig, arg(name="")] = field(default_factory=CalibrateConfig)
    overwrite: bool = False
    """Replace an earlier model."""

    def run(self) -> None:
        from morgs_mi.calibration.calibrate import calibrate

        with progress() as report:
            found = calibrate(
                self.folder, self.config, self.overwrite, lambda stage, done, total: report(stage, done, total)
            )
        if found.left_out:
            warn(f"{found.model}: {', '.join(found.left_out)} could not be tied to the others and have no camera.")
        say(
            f"{found.model}: {len(found.cameras)} cameras, {found.points} points, mean reprojection error "
            f"{found.error:.2f} px; its world has no scale and no up."
        )
