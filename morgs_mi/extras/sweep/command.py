"""`morgs-mi sweep`: error against run time of a capture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result, print_table, progress
from morgs_mi.cli.settings import (
    Flag,
    HeldOut,
    Settings,
    held_out,
    optional,
    options,
    place,
)
from morgs_mi.extras.sweep.vary import Vary
from morgs_mi.loop.stream_config import PresetName


@options
class Sweep:
    """Fit and score a capture with several presets, numbers of steps and epochs, and seeds: error
    against run time.

    Results are written after each fit. Fits that are in OUT are not made again.
    """

    capture: Positional[Path]
    """Folder of the capture."""
    out: Annotated[Positional[Path], place("OUT")] = Path("sweep")
    """Folder for the streams, sweep.json and sweep.png, by default sweep."""
    presets: tuple[PresetName | Literal["default"], ...] = ("baseline", "default")
    """Presets; default: the settings as they are."""
    epochs: tuple[int, ...] = Vary.epochs
    """Passes over the views for every later frame."""
    first_frame_steps: tuple[int, ...] = Vary.first_frame_steps
    """Steps of fits of the first frame alone."""
    measure: Annotated[str, arg(metavar="NAME")] = Vary.measure
    """Score that is compared: psnr, psnr_moving, ssim, motion_error_moving or lpips:FILE.onnx."""
    seeds: int = 3
    """Number of fits with each, in turn with the others; scores are averaged."""
    frames: int = 8
    """Most frames that are fitted, from the first one."""
    leave_out: Flag = False
    """Leave out each part of the method alone instead, and print the settings that the scene does
    not need.
    """
    tolerance: float = 0.05
    """Loss of PSNR up to which a part is not needed, dB; of motion error, bytes and seconds 5 %."""
    downscale: float = 1
    """Factor by which the images are reduced."""
    hold_out: HeldOut = ("auto",)
    """Held-out cameras, by indices or names; none: all are fitted; auto: the capture's, or camera 0
    of six or more.
    """
    config: Annotated[Path | None, optional("FILE.toml")] = None
    """File with any settings, as `fit --print-config` writes it."""

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.extras.sweep.sweep import CONFIGS, leave_out, sweep
        from morgs_mi.platform.bounded import read_json
        from morgs_mi.platform.config import apply_values
        from morgs_mi.platform.plots import check_plot

        results = self.out / ("leave-out.json" if self.leave_out else "sweep.json")
        check_plot(results.with_suffix(".png"))
        config = Settings(config=self.config).stream_config()
        configs = {name: apply_values(config, CONFIGS[name]) for name in self.presets}
        capture = load_capture(self.capture, self.downscale, held_out(self.hold_out))
        common = (self.seeds, self.frames, self.out)
        try:
            with progress() as report:
                if self.leave_out:
                    leave_out(capture, self.tolerance, *common, config, report)
                else:
                    vary = Vary(self.epochs, self.first_frame_steps, self.measure)
                    sweep(capture, configs, vary, *common, report)
        except KeyboardInterrupt as error:
            print_document(read_json(results))
            error.add_note("The same command goes on from there.")
            raise
        print_document(read_json(results))
        print_result(f"Results: {results}, {results.with_suffix('.png')}")


def print_document(document: Mapping[str, Any]) -> None:
    """Print the tables and sentences in the JSON file of a result."""
    for title, (titles, *rows) in document["tables"].items():
        print_result(f"\n{title}")
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
        for column in titles:
            table.add_column(column, justify="right", vertical="bottom", no_wrap=True)
        table.columns[0].justify = "left"
        for row in rows:
            table.add_row(*row)
        print_table(table, ["first\nframe\ns"])
    print_result(f"\n{document['sentence']}\n{document['toml']}".rstrip())
