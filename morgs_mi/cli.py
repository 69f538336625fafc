"""The command line, and the only argument parser.

`morgs-mi synth`, `info`, `calibrate`, `fit`, `render`, `eval`, `demo` and `report`.

Results go to standard output; progress, warnings and complaints to standard error. What the user can set right is
one sentence and exit status 1, an interruption 130; `--debug` shows where it came from. Arguments that the parser
refuses give status 2.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from tyro.conf import Positional, arg

from morgs_mi.capture.calibrate import CalibrateConfig
from morgs_mi.demo import DemoConfig
from morgs_mi.evaluate.codec_report import CodecReportConfig
from morgs_mi.evaluate.flow_report import FlowReportConfig
from morgs_mi.evaluate.renderer_report import RendererReportConfig
from morgs_mi.evaluate.tables import figure, judgement_sentences, judgement_tables
from morgs_mi.fit.presets import PresetName, apply_preset
from morgs_mi.stream_loop import StreamConfig

__all__ = ["main"]

# Rich would wrap paths and sentences at 80 columns where there is no terminal.
_OUT, _ERR = Console(soft_wrap=True, highlight=False), Console(stderr=True, soft_wrap=True, highlight=False)
Report = Callable[[str, float, float], None]


@dataclass(frozen=True)
class Synth:
    """Path-trace a moving scene into a multi-view capture with exact ground truth."""

    scene: Positional[str]
    """Name of a scene (spheres, arm) or the path of its Python file."""
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
    fps: float = 30.0
    """Frames per second."""
    lossless: bool = False
    """Also write the frames as PNG files."""
    seed: int = 0
    """Of textures, sampling noise and the choice of points."""
    overwrite: bool = False
    """Replace an earlier capture."""

    def run(self) -> None:
        from morgs_mi.capture.synth import synthesize

        with _progress() as report:
            synthesize(
                self.scene,
                self.out,
                num_cameras=self.cameras,
                num_frames=self.frames,
                width=self.width,
                height=self.height,
                spp=self.spp,
                fps=self.fps,
                lossless=self.lossless,
                seed=self.seed,
                overwrite=self.overwrite,
                progress=lambda done, total: report("Path-tracing", done, total),
            )
        _say(f"{self.out}: {self.cameras} cameras, {self.frames} frames of {self.width}x{self.height}.")


@dataclass(frozen=True)
class Info:
    """Say what a capture holds: layout, cameras, sizes, frames, points, and whether the poses fit the pictures."""

    capture: Positional[Path]
    """Folder of the capture."""
    plot: Path | None = None
    """Picture of the rig, .png or .jpg."""
    check: bool = True
    """Compare the poses with what the views of the first frame have in common."""

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.capture.rig_check import check_rig, find_common, with_points
        from morgs_mi.capture.rig_plot import write_rig

        capture, found = load_capture(self.capture), None
        origin = "" if len(capture.points) else "without points"
        if self.check:
            with _progress() as report:
                common = find_common(capture, lambda done, total: report("Matching views", done, total))
            found = check_rig(capture, common)
            if origin:
                capture = with_points(capture, common)
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
        _OUT.print(table)
        points = origin or f"{len(capture.points)} points"
        truth = "with ground truth" if capture.truth else "without ground truth"
        _say(f"{capture.num_frames} frames at {capture.fps:g} fps, {points}, {truth}.")
        if found:
            error = f"median {found.error:.2f} px over " if found.matches else ""
            _say(f"Reprojection check: {error}{found.matches} matches in {found.pairs} pairs; {found.advice}")
        if self.plot is not None:
            write_rig(self.plot, capture)
            _say(f"The rig: {self.plot}")


@dataclass(frozen=True)
class Calibrate:
    """Find the cameras of a folder of clips with COLMAP, and write FOLDER/sparse/0."""

    folder: Positional[Path]
    """Folder of videos, or of a folder of images per camera."""
    config: Annotated[CalibrateConfig, arg(name="")] = field(default_factory=CalibrateConfig)
    overwrite: bool = False
    """Replace an earlier model."""

    def run(self) -> None:
        from morgs_mi.capture.calibrate import calibrate

        with _progress() as report:
            found = calibrate(
                self.folder, self.config, self.overwrite, lambda stage, done, total: report(stage, done, total)
            )
        if found.left_out:
            _warn(f"{found.model}: {', '.join(found.left_out)} could not be tied to the others and have no camera.")
        _say(
            f"{found.model}: {len(found.cameras)} cameras, {found.points} points, mean reprojection error "
            f"{found.error:.2f} px; its world has no scale and no up."
        )


@dataclass(frozen=True)
class Fit:
    """Reconstruct a capture, frame after frame, into OUT/stream.morgs."""

    capture: Positional[Path]
    """Folder of the capture."""
    out: Positional[Path]
    """Folder for stream.morgs and report.json; an earlier stream there is replaced."""
    frames: int | None = None
    """Use at most this many frames from the start."""
    downscale: float = 1
    """Average the images down by this factor."""
    test_view: int | Literal["auto"] | None = "auto"
    """Index of the camera to hold out; auto takes the capture's own choice, or camera 0 of six or more."""
    preset: PresetName | None = None
    """The paper's variants (l: 8 passes over the views, s: 5), the rows of its ablation (residuals only, with motion,
    with offset, with confidence), or all of it without lifted flow; what it does not set stays as given."""
    config: Annotated[StreamConfig, arg(name="")] = field(default_factory=StreamConfig)

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.stream_loop import stream_capture

        config = self.config
        if self.preset is not None:
            fit, motion = apply_preset(self.preset, config.fit, config.motion)
            config = replace(config, fit=fit, motion=motion)
        capture = load_capture(self.capture, self.downscale, self.test_view, self.frames)
        count = capture.num_frames
        with _progress() as report:
            reports = stream_capture(
                capture,
                self.out,
                config,
                lambda frame, step, steps: report("Fitting frames", frame + step / steps, count),
            )
        seconds = [row.seconds for row in reports[1:]]
        later = f", {sum(seconds) / len(seconds):.1f} s for each later one" if seconds else ""
        stream = self.out / "stream.morgs"
        _say(
            f"{stream}: {len(reports)} frames, {stream.stat().st_size / 1e6:.1f} MB, "
            f"{reports[0].seconds:.1f} s for the first frame{later}."
        )


@dataclass(frozen=True)
class Render:
    """Render a stream for one camera into a video, EXR files or PNG files."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    camera: str
    """Camera of the stream, by index or name."""
    channels: tuple[Literal["color", "motion", "confidence", "depth", "alpha"], ...] | None = None
    """What to render; by default the colour, in EXR files all that the stream holds."""
    output: Path | None = None
    """FILE.mp4, a folder for PNG files whose name ends in png, or another new folder for multichannel EXR files (R, G,
    B in linear light, motion.X, motion.Y in pixels, confidence.Y, depth.Y); by default OUT/CAMERA.mp4."""

    def run(self) -> None:
        from morgs_mi.evaluate.frames import write_frames
        from morgs_mi.evaluate.stream import find_camera, open_stream

        stream = open_stream(self.out)
        camera = find_camera(stream, self.camera)
        output = self.output or stream.path.with_name(f"{camera.name}.mp4")
        total = stream.metadata.get("num_frames", 0)
        with _progress() as report:
            write_frames(
                stream, camera, output, self.channels, lambda done: report("Rendering", done, max(total, done))
            )
        _say(f"{output}: camera {camera.name}, {camera.width}x{camera.height}.")


@dataclass(frozen=True)
class Eval:
    """Measure a stream against its capture: quality, motion, bytes and seconds."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    capture: Path | None = None
    """Folder of the capture, if it is no longer where it was fitted from."""
    json: Path | None = None
    """File for all figures; - prints them in place of the tables."""
    pictures: Path | None = None
    """Folder for slice.png (one column over time), motion.png and confidence.png."""
    lpips: Path | None = None
    """LPIPS network as ONNX with inputs in0 and in1, RGB [1, 3, H, W] from -1 to 1; none comes with the package."""

    def run(self) -> None:
        from morgs_mi.evaluate.drawings import draw_stream
        from morgs_mi.evaluate.judge import evaluate_stream
        from morgs_mi.evaluate.lpips import Lpips
        from morgs_mi.evaluate.report import machine, versions
        from morgs_mi.files import finite, write_json

        network = None if self.lpips is None else Lpips(self.lpips)
        with _progress() as report:
            result = evaluate_stream(self.out, self.capture, partial(report, "Judging frames"), network)
            if self.pictures is not None:
                draw_stream(self.out, self.pictures, self.capture, partial(report, "Drawing frames"))
        result |= {"machine": machine(), "versions": versions()}
        if self.json == Path("-"):
            _say(json.dumps(finite(result), indent=2))
            return
        _show(result)
        if self.json is not None:
            write_json(self.json, result)
            _say(f"All figures: {self.json}")
        if self.pictures is not None:
            _say(f"Pictures: {self.pictures}")


@dataclass(frozen=True)
class Demo:
    """Make a clip, reconstruct it with and without learned motion, and leave pictures and figures in OUT."""

    out: Positional[Path]
    """Folder for everything."""
    config: Annotated[DemoConfig, arg(name="")] = field(default_factory=DemoConfig)

    def run(self) -> None:
        from morgs_mi.demo import run_demo

        with _progress() as report:
            result = run_demo(self.out, self.config, report)
        full, compared = result["full"], result["comparison"]
        table = Table(title=f"held-out view, frames {_span(compared['frames'])}")
        for column in ("", "PSNR, dB", "SSIM", "flow error, px", "moving, px", "still, px"):
            table.add_column(column, justify="right" if column else "left")
        for name, title in (("full", "with motion"), ("plain", "without")):
            figures = compared[name]
            motion = (figure(figures[key], 2) for key in ("motion_error", "motion_error_moving", "motion_error_still"))
            table.add_row(title, figure(figures["psnr"], 2), figure(figures["ssim"], 4), *motion)
        _OUT.print(table)
        _say(
            f"Held-out PSNR {figure(full['psnr']['first'], 2)} dB in the first frame, "
            f"{figure(full['psnr']['last'], 2)} dB in the last of {full['num_frames']}; "
            f"{figure(full['seconds']['per_later_frame'], 1)} s and "
            f"{figure(full['bytes']['per_residual'] / 1e6, 2)} MB per later frame; "
            f"{result['seconds']['total']:.0f} s in all."
        )
        _say(f"Look at {self.out / 'side_by_side.mp4'} and {self.out / 'contact_sheet.png'};")
        _say(f"all figures are in {self.out / 'report.json'}.")


@dataclass(frozen=True)
class RendererReport:
    """Measure the renderer's settings: error against a float64 twin beside run time."""

    json: Path | None = None
    """File for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Picture of error against run time, .png or .svg; needs matplotlib."""
    config: Annotated[RendererReportConfig, arg(name="")] = field(default_factory=RendererReportConfig)

    def run(self) -> None:
        from morgs_mi.evaluate.renderer_report import plot_renderer, report_renderer
        from morgs_mi.files import finite, write_json

        with _progress() as report:
            result = report_renderer(self.config, report)
        if self.json == Path("-"):
            _say(json.dumps(finite(result), indent=2))
        else:
            _show_renderer(result)
        if self.json not in (None, Path("-")):
            write_json(self.json, result)
            _say(f"All figures: {self.json}")
        if self.plot is not None:
            plot_renderer(result, self.plot)


@dataclass(frozen=True)
class FlowReport:
    """Measure methods of optical flow: error against synthetic clips' true flow beside run time."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures with ground truth, as synth makes them."""
    json: Path | None = None
    """File for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Picture of error against run time, .png or .svg; needs matplotlib."""
    config: Annotated[FlowReportConfig, arg(name="")] = field(default_factory=FlowReportConfig)

    def run(self) -> None:
        from morgs_mi.evaluate.flow_report import markdown_table, plot_flow, report_flow
        from morgs_mi.files import finite, write_json

        with _progress() as report:
            result = report_flow(self.captures, self.config, report)
        if self.json == Path("-"):
            _say(json.dumps(finite(result), indent=2))
        else:
            for clip in result["clips"]:
                title = f"{clip['name']}: {clip['pairs']} pairs of {clip['width']}x{clip['height']} pixels"
                _say(f"{title}, motion of {figure(clip['motion'], 1)} px\n\n{markdown_table(clip)}")
        if self.json not in (None, Path("-")):
            write_json(self.json, result)
            _say(f"All figures: {self.json}")
        if self.plot is not None:
            plot_flow(result, self.plot)


@dataclass(frozen=True)
class CodecReport:
    """Measure the stream: bytes per frame against quality against time, beside lzma over raw residuals."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures; each is fitted once per quality."""
    out: Path = Path("out/codec")
    """Folder for the streams, which stay there."""
    json: Path | None = None
    """File for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Picture of bytes against quality and time, .png or .svg; needs matplotlib."""
    config: Annotated[CodecReportConfig, arg(name="")] = field(default_factory=CodecReportConfig)

    def run(self) -> None:
        from morgs_mi.evaluate.codec_report import markdown_table, plot_codec, report_codec
        from morgs_mi.files import finite, write_json

        with _progress() as report:
            result = report_codec(self.captures, self.out, self.config, report)
        if self.json == Path("-"):
            _say(json.dumps(finite(result), indent=2))
        else:
            for clip in result["clips"]:
                _say(f"{clip['name']}\n\n{markdown_table(clip)}")
        if self.json not in (None, Path("-")):
            write_json(self.json, result)
            _say(f"All figures: {self.json}")
        if self.plot is not None:
            plot_codec(result, self.plot)


@dataclass(frozen=True)
class Measure:
    """Measure a part of the package: error beside run time."""

    subject: Annotated[
        Annotated[RendererReport, tyro.conf.subcommand("renderer")]
        | Annotated[FlowReport, tyro.conf.subcommand("flow")]
        | Annotated[CodecReport, tyro.conf.subcommand("codec")],
        arg(name=""),
    ]

    def run(self) -> None:
        self.subject.run()


Command = (
    Annotated[Synth, tyro.conf.subcommand("synth")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Measure, tyro.conf.subcommand("report")]
)


@dataclass(frozen=True)
class Options:
    """Dynamic Gaussian splatting in Mitsuba 3: a multi-view clip goes in, a stream of moving Gaussians comes out."""

    command: Annotated[Command, arg(name="")]
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Mitsuba's variant: llvm_ad_rgb runs on any processor, cuda_ad_rgb on an NVIDIA GPU."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show where an error came from, and more of what happens."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status; `args` default to those of the process."""
    args = sys.argv[1:] if args is None else list(args)
    try:
        options = tyro.cli(
            Options,
            prog="morgs-mi",
            args=args,
            config=(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes),
        )
        _set_up(options)
        options.command.run()
        return 0
    except (KeyboardInterrupt, ValueError, OSError, MemoryError, ArithmeticError) as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        sentence = "Interrupted; a stream file is whole up to its last frame." if interrupted else str(error)
        _warn(" ".join(sentence.split()) or f"{type(error).__name__}.")
        # A setting may be refused before there are options to ask.
        if "--debug" in args:
            _ERR.print_exception()
        return 130 if interrupted else 1


def _set_up(options: Options) -> None:
    """Send warnings to standard error and choose Mitsuba's variant."""
    import mitsuba as mi

    level = logging.DEBUG if options.debug else logging.WARNING
    logging.basicConfig(
        level=level, format="%(message)s", handlers=[RichHandler(console=_ERR, show_time=False, show_path=False)]
    )
    try:
        mi.set_variant(options.variant)
    except ImportError as error:
        raise ValueError(f"--variant {options.variant} cannot be used here ({error}); try llvm_ad_rgb.") from error


@contextmanager
def _progress() -> Iterator[Report]:
    """Show a bar per stage; give a function to be called with (stage, done, total)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=_ERR) as progress:

        def report(stage: str, done: float, total: float) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, count=0)
            progress.update(tasks[stage], completed=done, total=total, count=int(done))

        yield report


def _show(result: Mapping[str, Any]) -> None:
    """Print what `evaluate_stream` has found."""
    for table in judgement_tables(result):
        _OUT.print(table)
    for sentence in judgement_sentences(result):
        _say(sentence)
    if not result["complete"]:
        _warn(f"{result['stream']}: the fit was not finished, its stream holds {result['num_frames']} frames.")


def _show_renderer(result: Mapping[str, Any]) -> None:
    """Print what `report_renderer` has found."""
    attributes = list(result["rows"][0]["gradients"])
    for against, pick in (
        ("no cut-off at all", lambda row: row),
        ("the same alpha_min (float32 and early stop)", lambda row: row["rounding"]),
    ):
        image, gradients = (
            Table(title=f"{what} against {against}", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
            for what in ("image", "gradients: relative L2 error")
        )
        for table in (image, gradients):
            table.add_column("setting", no_wrap=True)
        names = (name.replace("_", " ") for name in attributes)
        for table, columns in (
            (image, ("forward ms", "step ms", "times default", "max", "RMS", "PSNR dB")),
            (gradients, (*names, "least cosine")),
        ):
            for column in columns:
                table.add_column(column, justify="right", min_width=max(7, *map(len, column.split())))
        for row in result["rows"]:
            errors, name = pick(row), f"{row['knob']} {row['value']}"
            style = "bold" if row["default"] else None
            times = (figure(row["forward_ms"], 1), figure(row["step_ms"], 1), figure(row["step_ratio"], 2))
            pixels = errors["image"]
            image.add_row(
                name, *times, f"{pixels['max']:.1e}", f"{pixels['rms']:.1e}", figure(pixels["psnr"], 1), style=style
            )
            found = errors["gradients"].values()
            cosine = min(gradient["cosine"] for gradient in found)
            gradients.add_row(name, *(f"{g['relative_l2']:.1e}" for g in found), f"{cosine:.5f}", style=style)
        _OUT.print(image)
        _OUT.print(gradients)


def _span(frames: Sequence[int]) -> str:
    return f"{frames[0]} to {frames[-1]}" if frames else "none"


def _say(text: str) -> None:
    _OUT.print(text, markup=False)


def _warn(text: str) -> None:
    _ERR.print(text, markup=False)


if __name__ == "__main__":
    sys.exit(main())
