"""Reports on error and run time of the renderer, optical flow, the codec and the method.

    python -m benchmarks.reports renderer --json out.json
    python -m benchmarks.reports flow CAPTURE... --json out.json
    python -m benchmarks.reports codec CAPTURE... --out out/codec
    python -m benchmarks.reports method CAPTURE... --out out/method --workers 2

Without `--json` the figures are printed as tables. `morgs-mi synth` writes captures with ground truth.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import Positional, arg

from benchmarks.reports.cells import OnWorkers
from benchmarks.reports.codec import CodecReportConfig
from benchmarks.reports.flow import FlowReportConfig
from benchmarks.reports.method import MethodReportConfig
from benchmarks.reports.method_results import MethodResult
from benchmarks.reports.renderer import Errors, RendererReportConfig, RendererResult, RendererRow
from morgs_mi.cli import Common, run
from morgs_mi.cli.console import OUT, print_result, progress
from morgs_mi.core.files import json_finite, write_json
from morgs_mi.evaluate.tables import figure

__all__ = ["CodecReport", "FlowReport", "MethodReport", "RendererReport"]


@dataclass(frozen=True)
class RendererReport:
    """Measure error and run time of the renderer's settings, compared with a float64 reference."""

    json: Path | None = None
    """JSON file for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Plot of error over run time, .png or .svg; needs matplotlib."""
    config: Annotated[RendererReportConfig, arg(name="")] = field(default_factory=RendererReportConfig)

    def run(self) -> None:
        from benchmarks.reports.renderer import plot_renderer, report_renderer

        with progress() as report:
            result = report_renderer(self.config, report)
        if _in_tables(result.as_dict(), self.json):
            _show_renderer(result)
        if self.plot is not None:
            plot_renderer(result, self.plot)


@dataclass(frozen=True)
class FlowReport:
    """Measure error and run time of optical flow on synthetic clips."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures with ground truth, as written by synth."""
    json: Path | None = None
    """JSON file for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Plot of error over run time, .png or .svg; needs matplotlib."""
    config: Annotated[FlowReportConfig, arg(name="")] = field(default_factory=FlowReportConfig)

    def run(self) -> None:
        from benchmarks.reports.flow import markdown_table, plot_flow, report_flow

        with progress() as report:
            result = report_flow(self.captures, self.config, report)
        if _in_tables(result.as_dict(), self.json):
            for clip in result.clips:
                title = f"{clip.name}: {clip.pairs} pairs of {clip.width}x{clip.height} pixels"
                print_result(f"{title}, motion of {figure(clip.motion, 1)} px\n\n{markdown_table(clip)}")
        if self.plot is not None:
            plot_flow(result, self.plot)


@dataclass(frozen=True)
class CodecReport(OnWorkers):
    """Measure bytes, quality and time of the codec, compared with lzma over raw residuals."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures; each is fitted once per quality."""
    out: Path = Path("out/codec")
    """Output folder for the streams."""
    json: Path | None = None
    """JSON file for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Plot of quality and time over bytes, .png or .svg; needs matplotlib."""
    config: Annotated[CodecReportConfig, arg(name="")] = field(default_factory=CodecReportConfig)

    def run(self) -> None:
        from benchmarks.reports.codec import markdown_table, plot_codec, report_codec

        with progress() as report, self.opened() as workers:
            result = report_codec(self.captures, self.out, self.config, report, workers)
        if _in_tables(result.as_dict(), self.json):
            for clip in result.clips:
                print_result(f"{clip.name}\n\n{markdown_table(clip)}")
        if self.plot is not None:
            plot_codec(result, self.plot)


@dataclass(frozen=True)
class MethodReport(OnWorkers):
    """Measure the method's parts, key views, and quality over run time, with several seeds.

    Results stored in OUT are reused, so that an interrupted report continues.
    """

    captures: Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("out/method")
    """Output folder for method.md, method.json, fitted cells and, with matplotlib, method.png."""
    config: Annotated[MethodReportConfig, arg(name="")] = field(default_factory=MethodReportConfig)

    def run(self) -> None:
        from benchmarks.reports.method import report_method
        from benchmarks.reports.method_tables import method_page, plot_method

        def write(result: MethodResult) -> None:
            write_json(self.out / "method.json", result.as_dict())
            (self.out / "method.md").write_text(method_page(result), encoding="utf-8")
            if find_spec("matplotlib"):
                plot_method(result, self.out / "method.png")

        with progress() as report, self.opened() as workers:
            result = report_method(self.captures, self.out, self.config, report, write, workers)
        print_result(f"{method_page(result)}\nAll figures: {self.out / 'method.json'}")


Subject = (
    Annotated[RendererReport, tyro.conf.subcommand("renderer")]
    | Annotated[FlowReport, tyro.conf.subcommand("flow")]
    | Annotated[CodecReport, tyro.conf.subcommand("codec")]
    | Annotated[MethodReport, tyro.conf.subcommand("method")]
)


@dataclass(frozen=True)
class Options(Common):
    """Measure error and run time of a part of the package."""

    command: Annotated[Subject, arg(name="")] = tyro.MISSING


def _show_renderer(result: RendererResult) -> None:
    """Print the renderer's report."""
    attributes = list(result.rows[0].gradients)
    references: tuple[tuple[str, Callable[[RendererRow], Errors | RendererRow]], ...] = (
        ("no cut-off at all", lambda row: row),
        ("the same alpha_min (float32 and early stop)", lambda row: row.rounding),
    )
    for reference, errors_of in references:
        image, gradients = (
            Table(title=f"{what} compared with {reference}", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
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
        for row in result.rows:
            errors, name = errors_of(row), f"{row.knob} {row.value}"
            style = "bold" if row.default else None
            times = (figure(row.forward_ms, 1), figure(row.step_ms, 1), figure(row.step_ratio, 2))
            pixels = errors.image
            image.add_row(name, *times, f"{pixels.max:.1e}", f"{pixels.rms:.1e}", figure(pixels.psnr, 1), style=style)
            found = errors.gradients.values()
            cosine = min(gradient.cosine for gradient in found)
            gradients.add_row(name, *(f"{g.relative_l2:.1e}" for g in found), f"{cosine:.5f}", style=style)
        OUT.print(image)
        OUT.print(gradients)


def _in_tables(result: Mapping[str, Any], file: Path | None) -> bool:
    """Write all figures to `file`, or print them if it is -; return whether tables remain to be printed."""
    if file == Path("-"):
        print_result(json.dumps(json_finite(result), indent=2))
        return False
    if file is not None:
        write_json(file, result)
        print_result(f"All figures: {file}")
    return True


def main(args: Sequence[str] | None = None) -> int:
    """Run a report and return the exit status; `args` default to those of the process."""
    return run(Options, "python -m benchmarks.reports", args)


if __name__ == "__main__":
    sys.exit(main())
