"""`morgs-mi sweep`: error against run time of a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import Positional

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
from morgs_mi.loop.stream_config import PresetName


@options
class Sweep:
    """Fit and score a capture with several presets, numbers of epochs and seeds: error against run
    time.

    Fits that are in OUT are not made again.
    """

    capture: Positional[Path]
    """Folder of the capture."""
    out: Annotated[Positional[Path], place("OUT")] = Path("sweep")
    """Folder for the streams, sweep.json and sweep.png, by default sweep."""
    presets: tuple[PresetName | Literal["default"], ...] = ("baseline", "default")
    """Presets; default: the settings as they are."""
    epochs: tuple[int, ...] = (1, 2, 4, 8)
    """Passes over the views for every later frame."""
    seeds: int = 3
    """Number of fits with each, whose scores are averaged."""
    frames: int = 8
    """Most frames that are fitted, from the first one."""
    leave_out: Flag = False
    """Instead of presets and epochs, leave out each part of the method alone, and print the
    settings that the scene does not need.
    """
    tolerance: float = 0.05
    """Loss of PSNR up to which a part is not needed, dB."""
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
        from morgs_mi.core.plots import check_plot
        from morgs_mi.extras.sweep.sweep import leave_out, sweep

        name = "leave-out" if self.leave_out else "sweep"
        plot = self.out / f"{name}.png"
        check_plot(plot)
        config = Settings(config=self.config).stream_config()
        capture = load_capture(self.capture, self.downscale, held_out(self.hold_out))
        common = (self.seeds, self.frames, self.out, config)
        with progress() as report:
            if self.leave_out:
                result = leave_out(capture, self.tolerance, *common, report)
            else:
                result = sweep(capture, self.presets, self.epochs, *common, report)
        titles, *rows = result.table
        table = Table(*titles, box=SIMPLE_HEAD, title="means ± standard deviations over the seeds")
        for row in rows:
            table.add_row(*row)
        print_table(table)
        result.plot(plot)
        print_result(f"{result.sentence}\n{result.toml}\nResults: {self.out / name}.json, {plot}")
