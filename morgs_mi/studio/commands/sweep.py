"""`morgs-mi sweep`: error against run time of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.box import SIMPLE_HEAD
from rich.table import Table
from tyro.conf import DisallowNone, Positional

from morgs_mi.cli.console import print_result, print_table, progress
from morgs_mi.cli.settings import HeldOut, Settings, held_out, optional


@dataclass(frozen=True)
class Sweep:
    """Fit and score a capture with several numbers of epochs: error against run time."""

    capture: Positional[Path]
    """Folder of the capture."""
    out: Positional[Path]
    """Folder for the streams and sweep.json."""
    epochs: tuple[int, ...] = (1, 2, 4, 8)
    """Passes over the views for every later frame, of each fit."""
    seeds: int = 1
    """Number of fits with each, whose scores are averaged."""
    frames: Annotated[int | None, DisallowNone, optional("INT", "(default: all)")] = None
    """Number of frames to fit, from the first one."""
    downscale: float = 1
    """Factor by which the images are reduced."""
    test_view: HeldOut = ("auto",)
    """Held-out cameras, by indices or names; none: all are fitted; auto: the capture's, or camera 0
    of six or more.
    """
    config: Annotated[Path | None, DisallowNone, optional("FILE.toml")] = None
    """File with any settings, as `fit --print-config` writes it."""
    plot: Annotated[Path | None, DisallowNone, optional("FILE")] = None
    """Plot of the scores over time: .png, .jpg, .svg or .pdf; needs the extra plots."""

    def run(self) -> None:
        from morgs_mi.capture.capture import load_capture
        from morgs_mi.core.plots import check_plot
        from morgs_mi.evaluate.tables import figure
        from morgs_mi.studio.sweep import SCORES, mean_scores, sweep, write_sweep_plot

        if self.plot is not None:
            check_plot(self.plot)
        config = Settings(config=self.config).stream_config()
        capture = load_capture(self.capture, self.downscale, held_out(self.test_view), self.frames)
        with progress() as report:
            rows = sweep(capture, self.out, self.epochs, self.seeds, config, report)
        titles = (title for title, _ in SCORES.values())
        table = Table("epochs", *titles, box=SIMPLE_HEAD, title="means over the seeds")
        for row in mean_scores(rows):
            cells = (figure(row[name], digits) for name, (_, digits) in SCORES.items())
            table.add_row(figure(row["epochs"], 0), *cells)
        print_table(table)
        print_result(f"All fits: {self.out / 'sweep.json'}")
        if self.plot is not None:
            write_sweep_plot(self.plot, rows)
            print_result(f"Plot: {self.plot}")
