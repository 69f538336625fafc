"""`morgs-mi info` and `calibrate`: the contents of a capture, and camera poses from its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from functools import partial
from pathlib import Path
from typing import Annotated

from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import FlagCreatePairsOff, Positional, arg

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.outputs import check_output
from morgs_mi.capture.points import match_capture, triangulate_points
from morgs_mi.cli.console import (
    print_next,
    print_result,
    print_table,
    print_warning,
    progress,
)
from morgs_mi.cli.settings import (
    Flag,
    GivenReading,
    Reading,
    Without,
    optional,
    options,
)
from morgs_mi.cli.streams import opened
from morgs_mi.extras.calibration.calibrate import CalibrateConfig
from morgs_mi.extras.calibration.checks.plots import write_rig
from morgs_mi.extras.calibration.checks.rig_check import CameraCheck, RigCheck, check_rig
from morgs_mi.extras.calibration.timing import TimeOffsets, estimate_time_offsets
from morgs_mi.fit.forecast import forecast
from morgs_mi.platform.checks import quantity, require
from morgs_mi.platform.files import STREAM
from morgs_mi.platform.plots import check_plot
from morgs_mi.playback.streams import SplatFile

# Colours of the verdict on views between the cameras.
_STYLES = {"good": "green", "fair": "yellow", "poor": "red"}
# Columns of a camera, after its index and name.
_COLUMNS = (
    "size",
    "focal, px",
    "centre, px",
    "seen",
    "use",
    "matches",
    "error, px",
    "pose",
)
# Standard error in frames from which a time offset counts as not found.
_NOT_FOUND = 0.5
_ABOUT_CLOCKS = (
    "Offsets with errors above 0.1 are uncertain, and from 0.5 not found: the images hardly depend "
    "on the clocks, because little moves, or in a direction in which an offset looks like a change "
    "of depth, or the cameras are far apart."
)


@options
class Info:
    """List the contents of a capture: layout, cameras, sizes, frames, points; check its poses
    against the images. Of a stream or a file: its Gaussians.
    """

    capture: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """Folder of a capture or a fit, a stream file, or a file of Gaussians."""
    plot: Annotated[Path | None, optional("FILE")] = None
    """File for a plot of the rig, .png, .jpg, .svg or .pdf."""
    check: Annotated[bool, arg(help_behavior_hint="(default: --check)")] = True
    """Check the poses against feature matches between the views of the first frame."""
    time: Flag = False
    """Estimate the time offsets of the cameras from what moves in the first frames."""
    reading: GivenReading = field(default_factory=Reading)

    def run(self) -> None:
        if self.plot is not None:
            check_output(self.plot)
            check_plot(self.plot)
        fits = [self.capture / STREAM, *self.capture.glob(f"*/{STREAM}")]
        if self.capture.is_file() or any(fit.is_file() for fit in fits):
            require(
                self == Info(self.capture),
                self.capture,
                "expected a capture, which the options of info are for",
                "a stream",
                "leave them out",
            )
            _print_stream(self.capture)
            return
        capture = load_capture(self.capture, reading=self.reading.read_config())
        count = len(capture.points)
        points = quantity(count, "point") if count else "without points"
        rig_check = None
        if self.check:
            with progress() as report:
                shared = match_capture(capture, partial(report, "Matching views"))
            rig_check = check_rig(capture, shared)
            if not count:
                capture = triangulate_points(capture, shared)
                points += f" ({len(capture.points)} can be triangulated)"
        train_cameras = capture.views.train.cameras
        if len(train_cameras) > 1:
            views = forecast(train_cameras, capture.points)
            print_result(views.sentence, _STYLES[views.quality])
        if rig_check is not None:
            error = f"median {rig_check.error:.2f} px over " if rig_check.matches else ""
            print_result(
                f"Reprojection check: {error}{rig_check.matches} matches in "
                f"{quantity(rig_check.pairs, 'pair')}; {rig_check.advice}"
            )
            for line in _advice_lines(rig_check.cameras):
                print_result(line)
        truth = "with ground truth" if capture.truth else "without ground truth"
        print_result(
            f"{quantity(capture.num_frames, 'frame')} at {capture.fps:g} fps "
            f"({capture.names[0]}: {capture.first_clip}), {points}, {truth}."
        )
        for note in capture.notes:
            print_result(note)
        dispensable = ("centre, px", "size", "focal, px", "seen")
        print_table(_camera_table(capture, rig_check), dispensable)
        if self.time:
            with progress() as report:
                offsets = estimate_time_offsets(capture, partial(report, "Comparing clocks"))
            _print_clocks(offsets)
        if self.plot is not None:
            write_rig(self.plot, capture)
            print_result(f"Plot of the rig: {self.plot}")
        print_next("fit", self.capture, f"{self.capture.resolve().name}-fit")


def _print_stream(path: Path) -> None:
    """Print what a stream, or a file of Gaussians, has in its first frame."""
    stream = opened(path, drop_invalid=False, skip_damaged=True)
    frames = len(stream.frame_numbers())
    gaussians = next(stream.states()).gaussians
    print_result(
        f"{stream.path}: {len(gaussians):,} Gaussians, SH degree {gaussians.sh_degree}, "
        f"{'moving' if frames > 1 else 'still'}, {gaussians.size} units, "
        f"{stream.path.stat().st_size / 1e6:.1f} MB."
    )
    if not isinstance(stream, SplatFile):  # which has no time
        cameras = quantity(len(stream.cameras), "camera")
        print_result(f"{quantity(frames, 'frame')} at {stream.fps:g} fps, {cameras}.")
    print_next("view", path)


@options
class Calibrate:
    """Calibrate the cameras of a folder of clips with COLMAP, and write FOLDER/sparse/0."""

    capture: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder of videos, or of one folder of images per camera."""
    config: Annotated[CalibrateConfig, arg(name=""), FlagCreatePairsOff] = field(
        default_factory=CalibrateConfig
    )
    exclude: Without = ()
    """Cameras that are left out, by name."""
    overwrite: Flag = False
    """Replace an earlier model in FOLDER/sparse."""

    def run(self) -> None:
        from morgs_mi.extras.calibration.calibrate import calibrate

        with progress() as report:
            result = calibrate(
                self.capture,
                self.config,
                self.overwrite,
                report,
                self.exclude,
            )
        table = _check_table(str(result.model), ("camera", "points", "error, px", "pose"))
        for check in result.checks:
            table.add_row(check.name, *_check_cells(check))
        print_table(table)
        for line in _advice_lines(result.checks):
            print_warning(line)
        points = ", with a principal point for each" if result.principal_points else ""
        print_result(
            f"{result.model}: {len(result.cameras)} cameras, {result.points} points, mean "
            f"reprojection error {result.error:.2f} px, by {result.mapper} mapping{points}; scale "
            "and up direction of its world are arbitrary."
        )
        print_next("info", self.capture)


def _camera_table(capture: Capture, rig_check: RigCheck | None) -> Table:
    """Return a row per camera: size, intrinsics, use, and how well its pose fits the matches."""
    table = _check_table(f"{capture.path}: {capture.layout}", ("", "camera", *_COLUMNS))
    for index, camera in enumerate(capture.cameras):
        K = camera.K
        fx = f"{K[0, 0]:.1f}"
        fy = f"{K[1, 1]:.1f}"
        mask = capture.masks[index]
        table.add_row(
            str(index),
            camera.name,
            f"{camera.width}x{camera.height}",
            fx if fx == fy else f"{fx} {fy}",
            f"{K[0, 2]:.1f} {K[1, 2]:.1f}",
            "100 %" if mask is None else f"{100 * mask.mean():.0f} %",
            "test" if index in capture.test_views else "train",
            *_check_cells(rig_check.cameras[index] if rig_check else None),
        )
    return table


def _print_clocks(offsets: TimeOffsets) -> None:
    """Print the time offsets with their errors, and the option that aligns the clips."""
    table = _check_table("Clocks", ("camera", "offset, frames", "standard error"))
    for name, error in offsets.errors.items():
        table.add_row(name, f"{offsets.offsets[name]:.2f}", f"{error:.2f}")
    print_table(table)
    option = " ".join(
        f"{name} {offsets.offsets[name]:.2f}"
        for name, error in offsets.errors.items()
        if name != offsets.reference and error < _NOT_FOUND
    )
    if option:
        print_result(f"Pass --offset {option} for the time of {offsets.reference}.")
    print_result(_ABOUT_CLOCKS)
    if not offsets.converged:
        print_result(
            f"The offsets still change by {offsets.change:.2f} frames: the clips may not show "
            "enough."
        )


def _check_table(title: str, columns: Sequence[str]) -> Table:
    """Return a table without rows, whose cells are not wrapped."""
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in columns:
        table.add_column(column, no_wrap=True)
    return table


def _check_cells(check: CameraCheck | None) -> tuple[str, str, str]:
    """Return the number of matches, the error and the verdict of a camera as text."""
    if check is None:
        return "-", "-", "not checked"
    return str(check.matches), f"{check.error:.2f}" if check.matches else "-", check.verdict


def _advice_lines(checks: Sequence[CameraCheck]) -> list[str]:
    """Return a sentence per advice, with the names of the cameras that it concerns."""
    names: dict[str, list[str]] = {}
    for check in checks:
        if check.advice:
            names.setdefault(f"{check.verdict}: {check.advice}.", []).append(check.name)
    return [f"{', '.join(cameras)} {text}" for text, cameras in names.items()]
