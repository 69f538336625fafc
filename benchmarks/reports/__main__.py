"""`python -m benchmarks.reports`: error against run time, of the renderer, optical flow, the codec and the method."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import Positional, arg

from benchmarks.reports.codec import CodecReportConfig
from benchmarks.reports.flow import FlowReportConfig
from benchmarks.reports.method import MethodReportConfig
from benchmarks.reports.renderer import RendererReportConfig
from morgs_mi.cli import Common, run
from morgs_mi.cli.console import OUT, print_result, progress
from morgs_mi.core.files import finite, write_json
from morgs_mi.evaluate.tables import figure

__all__ = ["CodecReport", "FlowReport", "MethodReport", "RendererReport"]


@dataclass(frozen=True)
class RendererReport:
    """Measure the renderer's settings: error against a float64 twin beside run time."""

    json: Path | None = None
    """File for all figures; - prints them in place of the tables."""
    plot: Path | None = None
    """Picture of error against run time, .png or .svg; needs matplotlib."""
    config: Annotated[RendererReportConfig, arg(name="")] = field(default_factory=RendererReportConfig)

    def run(self) -> None:
        from benchmarks.reports.renderer import plot_renderer, report_renderer

        with progress() as report:
            result = report_renderer(self.config, report)
        if _in_tables(result, self.json):
            _show_renderer(result)
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
        from benchmarks.reports.flow import markdown_table, plot_flow, report_flow

        with progress() as report:
            result = report_flow(self.captures, self.config, report)
        if _in_tables(result, self.json):
            for clip in result["clips"]:
                title = f"{clip['name']}: {clip['pairs']} pairs of {clip['width']}x{clip['height']} pixels"
                print_result(f"{title}, motion of {figure(clip['motion'], 1)} px\n\n{markdown_table(clip)}")
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
        from benchmarks.reports.codec import markdown_table, plot_codec, report_codec

        with progress() as report:
            result = report_codec(self.captures, self.out, self.config, report)
        if _in_tables(result, self.json):
            for clip in result["clips"]:
                print_result(f"{clip['name']}\n\n{markdown_table(clip)}")
        if self.plot is not None:
            plot_codec(result, self.plot)


@dataclass(frozen=True)
class MethodReport:
    """Measure the method: its parts one after the other, key views, and quality against run time, over several seeds.

    What OUT holds already is not fitted again, so that an interrupted report goes on.
    """

    captures: Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("out/method")
    """Folder for method.md, method.json and, with matplotlib, method.png, and for what was fitted."""
    config: Annotated[MethodReportConfig, arg(name="")] = field(default_factory=MethodReportConfig)

    def run(self) -> None:
        from benchmarks.reports.method import report_method
        from benchmarks.reports.method_tables import method_page, plot_method

        def keep(result: Mapping[str, Any]) -> None:
            write_json(self.out / "method.json", result)
            (self.out / "method.md").write_text(method_page(result), encoding="utf-8")
            if find_spec("matplotlib"):
                plot_method(result, self.out / "method.png")

        with progress() as report:
            result = report_method(self.captures, self.out, self.config, report, keep)
        print_result(f"{method_page(result)}\nAll figures: {self.out / 'method.json'}")


Subject = (
    Annotated[RendererReport, tyro.conf.subcommand("renderer")]
    | Annotated[FlowReport, tyro.conf.subcommand("flow")]
    | Annotated[CodecReport, tyro.conf.subcommand("codec")]
    | Annotated[MethodReport, tyro.conf.subcommand("method")]
)


@dataclass(frozen=True)
class Options(Common):
    """Measure a part of the package: error beside run time."""

    command: Annotated[Subject, arg(name="")] = tyro.MISSING


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
        OUT.print(image)
        OUT.print(gradients)


def _in_tables(result: Mapping[str, Any], file: Path | None) -> bool:
    """Write all figures to `file`, or print them where it is -; return whether tables are still to be printed."""
    if file == Path("-"):
        print_result(json.dumps(finite(result), indent=2))
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
