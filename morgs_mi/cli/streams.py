"""`morgs-mi fit`, `render`, `eval`, `salvage` and `demo`: from a capture to a stream, and what it is worth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.table import Table
from tyro.conf import FlagCreatePairsOff, Positional, arg

from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.cli.console import OUT, progress, say, warn
from morgs_mi.demo import DemoConfig
from morgs_mi.evaluate.results import Evaluation
from morgs_mi.evaluate.tables import evaluation_summary, evaluation_tables, figure
from morgs_mi.presets import PresetName, apply_preset
from morgs_mi.stream_loop import StreamConfig

__all__ = ["Demo", "Eval", "Fit", "Render", "Salvage"]


@dataclass(frozen=True)
class Fit:
    """Reconstruct a capture, frame after frame, into OUT/stream.morgs."""

    capture: Positional[Path]
    """Folder of the capture."""
    out: Positional[Path]
    """Folder for stream.morgs and report.json; an earlier stream there is replaced, unless it is resumed."""
    frames: int | None = None
    """Use at most this many frames from the start."""
    downscale: float = 1
    """Average the images down by this factor."""
    test_view: int | Literal["auto"] | None = "auto"
    """Index of the camera to hold out; auto takes the capture's own choice, or camera 0 of six or more."""
    reading: Annotated[ReadConfig, arg(name="")] = field(default_factory=ReadConfig)
    preset: PresetName | None = None
    """The paper's variants (l: 8 passes over the views, s: 5), the rows of its ablation (residuals only, with motion,
    with offset, with confidence), or all of it without lifted flow; what it does not set stays as given."""
    resume: Annotated[bool, FlagCreatePairsOff] = False
    """Go on behind the last whole frame of the stream in OUT, with the same capture and settings. With
    --render.reproducible the stream becomes the very one of a fit that was not interrupted."""
    config: Annotated[StreamConfig, arg(name="")] = field(default_factory=StreamConfig)

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.recorder import stream_capture

        config = self.config
        if self.preset is not None:
            fit, motion = apply_preset(self.preset, config.fit, config.motion)
            config = replace(config, fit=fit, motion=motion)
        capture = load_capture(self.capture, self.downscale, self.test_view, self.frames, self.reading)
        count = capture.num_frames
        with progress() as report:
            reports = stream_capture(
                capture,
                self.out,
                config,
                lambda frame, step, steps: report("Fitting frames", frame + step / steps, count),
                self.resume,
            )
        seconds = [row.seconds for row in reports[1:]]
        later = f", {sum(seconds) / len(seconds):.1f} s for each later one" if seconds else ""
        stream = self.out / "stream.morgs"
        say(
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
        from morgs_mi.export.frames import write_frames
        from morgs_mi.playback.player import find_camera, open_stream

        stream = open_stream(self.out)
        camera = find_camera(stream, self.camera)
        output = self.output or stream.path.with_name(f"{camera.name}.mp4")
        total = stream.metadata.get("num_frames", 0)
        with progress() as report:
            write_frames(
                stream, camera, output, self.channels, lambda done: report("Rendering", done, max(total, done))
            )
        say(f"{output}: camera {camera.name}, {camera.width}x{camera.height}.")


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
    """Folder for slice.png (one column over time), motion.png, confidence.png and, where the stream holds offsets,
    offset.png."""
    lpips: Path | None = None
    """LPIPS network as ONNX with inputs in0 and in1, RGB [1, 3, H, W] from -1 to 1; none comes with the package."""

    def run(self) -> None:
        from morgs_mi.core.files import finite, write_json
        from morgs_mi.evaluate.environment import machine, versions
        from morgs_mi.evaluate.evaluate import evaluate_stream
        from morgs_mi.evaluate.figures import draw_stream
        from morgs_mi.evaluate.lpips import Lpips

        network = None if self.lpips is None else Lpips(self.lpips)
        with progress() as report:
            result = evaluate_stream(self.out, self.capture, partial(report, "Evaluating frames"), network)
            if self.pictures is not None:
                draw_stream(self.out, self.pictures, self.capture, partial(report, "Drawing frames"))
        figures = {**result.as_dict(), "machine": machine(), "versions": versions()}
        if self.json == Path("-"):
            say(json.dumps(finite(figures), indent=2))
            return
        _show(result)
        if self.json is not None:
            write_json(self.json, figures)
            say(f"All figures: {self.json}")
        if self.pictures is not None:
            say(f"Pictures: {self.pictures}")


@dataclass(frozen=True)
class Salvage:
    """Write what still plays of a damaged stream as a new one, and name the bytes that do not."""

    stream: Positional[Path]
    """Stream file, or the folder of a fit."""
    out: Positional[Path]
    """The new stream file."""

    def run(self) -> None:
        from morgs_mi.codec.salvage import write_salvaged
        from morgs_mi.playback.player import open_stream

        stream = open_stream(self.stream)
        frames, gaps = write_salvaged(stream, self.out)
        for gap in gaps:
            say(f"{stream.path}: bytes {gap.start} to {gap.stop}: {gap.problem.rstrip('.')}.")
        say(f"{self.out}: {len(frames)} frames, {_in_words(_runs(frames))}.")
        lost = _lost(sorted(frames), stream.metadata.get("num_frames"))
        if lost:
            count = sum(run.stop - run.start for run in lost)
            say(
                f"{count} frames cannot be played, {_in_words(lost)}: their packets are damaged, missing, or continue "
                "one that is; a stream plays on from the next intact keyframe."
            )


@dataclass(frozen=True)
class Demo:
    """Make a clip, reconstruct it with and without learned motion, and leave pictures and figures in OUT."""

    out: Positional[Path]
    """Folder for everything."""
    config: Annotated[DemoConfig, arg(name="")] = field(default_factory=DemoConfig)

    def run(self) -> None:
        from morgs_mi.demo import run_demo

        with progress() as report:
            result = run_demo(self.out, self.config, report)
        full, compared = result["full"], result["comparison"]
        table = Table(title=f"held-out view, frames {_span(compared['frames'])}")
        for column in ("", "PSNR, dB", "SSIM", "flow error, px", "moving, px", "still, px"):
            table.add_column(column, justify="right" if column else "left")
        for name, title in (("full", "with motion"), ("plain", "without")):
            figures = compared[name]
            motion = (figure(figures[key], 2) for key in ("motion_error", "motion_error_moving", "motion_error_still"))
            table.add_row(title, figure(figures["psnr"], 2), figure(figures["ssim"], 4), *motion)
        OUT.print(table)
        say(
            f"Held-out PSNR {figure(full['psnr']['first'], 2)} dB in the first frame, "
            f"{figure(full['psnr']['last'], 2)} dB in the last of {full['num_frames']}; "
            f"{figure(full['seconds']['per_later_frame'], 1)} s and "
            f"{figure(full['bytes']['per_residual'] / 1e6, 2)} MB per later frame; "
            f"{result['seconds']['total']:.0f} s in all."
        )
        say(f"Look at {self.out / 'side_by_side.mp4'} and {self.out / 'contact_sheet.png'};")
        say(f"all figures are in {self.out / 'report.json'}.")


def _show(result: Evaluation) -> None:
    """Print an evaluation."""
    for table in evaluation_tables(result):
        OUT.print(table)
    for sentence in evaluation_summary(result):
        say(sentence)
    if not result.complete:
        warn(f"{result.stream}: the fit was not finished, its stream holds {result.num_frames} frames.")


def _runs(numbers: Sequence[int]) -> list[range]:
    """Return ascending numbers as runs of consecutive ones."""
    runs = [[n for _, n in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    return [range(run[0], run[-1] + 1) for run in runs]


def _lost(frames: Sequence[int], total: Any) -> list[range]:
    """Return the runs that ascending frames leave out, out of so many if the stream's metadata says a number."""
    end = total if isinstance(total, int) else 0  # it may say anything, and be as large as it likes
    return [range(a + 1, b) for a, b in pairwise([-1, *frames, end]) if b - a > 1]


def _in_words(runs: Sequence[range]) -> str:
    """Return runs as text, e.g. ``0 to 3, 7``."""
    return ", ".join(f"{run[0]} to {run[-1]}" if run[-1] > run[0] else f"{run[0]}" for run in runs)


def _span(frames: Sequence[int]) -> str:
    return f"{frames[0]} to {frames[-1]}" if frames else "none"
