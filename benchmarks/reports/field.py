"""The methods of other publications beside this package's, on one renderer, one codec and one
number of steps.

    python -m benchmarks.reports.field --seeds 16 17 18 --json out.json --plot out.png

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings
were chosen on seeds 0 to 2. All methods continue from the same first frame of a clip. Image and
motion scores are means over the later frames of the held-out view, scores of tracks are over the
whole clip, all against the exact ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.field import anchors, hicom, motion_grid, rigidity, transformation_cache  # noqa: F401, they register models and terms
from benchmarks.reports.fits import DEFAULT, Clip, new_loop, random_capture
from benchmarks.reports.plots import Column, blank_figure, means_over, save_figure, scores_table
from benchmarks.reports.tracks import track_scores
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture
from morgs_mi.codec.packets import coded_frames
from morgs_mi.evaluate.results import known_mean
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.platform.config import apply_values
from morgs_mi.platform.files import json_finite

_FAST = {"fit": {"rates": {"means": 2e-3}}}
_RIGID = {"terms": ("rigid:0.4", "rotation:0.4", "isometry:0.2")}
# Motion with constant velocity as the start, and an appearance that stays as it is.
_RIGIDITY: dict[str, Any] = {
    "fit": {
        "objective": _RIGID,
        "density": {"later_frames": False},
        "decay_means_rate": False,
        "rates": {
            "means": 4e-3,
            "quats": 0.02,
            "scales": 0.0,
            "opacities": 0.0,
            "sh_dc": 0.0,
            "sh_rest": 0.0,
        },
    },
    "motion": {"constant_velocity": True},
}
# Presets and further settings by name, in the order of the tables; DEFAULT is no preset. The motion
# models and the rigid terms register themselves where they are imported.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "baseline": ("baseline", {}),
    # Of the means, tuned like the rates of the other methods.
    "baseline, 4x rate": ("baseline", _FAST),
    "hicom": ("baseline", {"motion": {"model": "hicom"}}),
    "rigidity": ("baseline", _RIGIDITY),
    "cache": ("baseline", {"motion": {"model": "cache"}}),
    "grid": ("baseline", {"motion": {"model": "grid"}}),
    "anchors": ("baseline", {"motion": {"model": "anchors"}}),
    "paper": ("paper", {}),
    "default": (DEFAULT, {}),
    "default + grid": (DEFAULT, {"motion": {"model": "grid-slow", "model_share": 0.25}}),
    "default + rigidity": (DEFAULT, {"fit": {"objective": _RIGID}}),
}
# Protocol of the scores of tracks.
_PROTOCOL = "Dynamic 3D Gaussians"
# Scores that are plotted: name and axis.
_PLOTTED = (
    ("psnr_moving", "PSNR where things move, dB"),
    ("motion_error_moving", "motion error where things move, px"),
)
_SCORES = ("psnr", "psnr_moving", "motion_error_moving")
COLUMNS = (
    Column("PSNR, dB", "psnr", spread=False),
    Column("moving, dB", "psnr_moving"),
    Column("motion error, px", "motion_error_moving", spread=False),
    Column("AJ, %", f"{_PROTOCOL} average_jaccard", 1, 100, spread=False),
    Column("MTE, %", f"{_PROTOCOL} median_error_percent", 1, spread=False),
    Column("kB", "num_bytes", 1, 1e-3, spread=False),
    Column("CPU s", "cpu_s", 1, spread=False),
)


@dataclass(frozen=True)
class Options(Output):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (16, 17, 18)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each scene."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    downscale: float = 1
    """Factor by which the images are reduced."""
    frames: int = 8
    """Number of frames, the first included."""
    epochs: tuple[int, ...] = (2, 8)
    """Epochs of a later frame."""
    num_gaussians: int | None = None
    """Gaussians of the first frame; default: by the detail of its images."""
    first_frame_steps: int | None = None
    """Steps of the first frame; default: until it has converged."""
    plot: Path | None = None
    """Plot of the errors over time and over bytes, .png or .svg; needs matplotlib."""

    def cells(self) -> dict[str, tuple[Capture, dict[str, StreamConfig]]]:
        """Return the clip, and the settings of each method and number of epochs, of each cell."""
        cells = {}
        for seed in self.seeds:
            capture = random_capture(self.clips, seed, self.downscale)
            capture = replace(capture, num_frames=min(self.frames, capture.num_frames))
            for fit_seed in self.fit_seeds:
                methods = {
                    f"{m}/{e}": self.settings(m, e, fit_seed) for e in self.epochs for m in METHODS
                }
                cells[f"{seed}/{fit_seed}"] = capture, methods
        return cells

    def settings(self, method: str, epochs: int, seed: int) -> StreamConfig:
        """Return the settings of a method."""
        preset, values = METHODS[method]
        config = StreamConfig() if preset == DEFAULT else apply_preset(StreamConfig(), preset)  # pyright: ignore[reportArgumentType]
        config = apply_values(config, values)
        work = {
            "num_gaussians": self.num_gaussians,
            "first_frame_steps": self.first_frame_steps,
            "epochs": epochs,
        }
        return replace(config, fit=replace(config.fit, **work), seed=seed)


def measure(capture: Capture, methods: Mapping[str, StreamConfig]) -> dict[str, dict[str, Any]]:
    """Fit a clip by each method after the same first frame and return the scores by method."""
    clip = Clip.read(capture)
    keyframe, _ = new_loop(capture, next(iter(methods.values()))).push(clip.images[0])
    rows = {}
    for method, config in methods.items():
        fit = clip.continued(keyframe, config)
        tracks = track_scores(coded_frames(fit.packets), capture, config.render)
        later_frames = fit.evaluation.frames[1:]
        series = {n: [getattr(row.scores, n) for row in later_frames] for n in _SCORES}
        scores = {
            **{name: known_mean(values) for name, values in series.items()},
            **{f"{_PROTOCOL} {name}": value for name, value in tracks.items()},
            "num_bytes": known_mean([report.num_bytes for report in fit.reports]),
            "cpu_s": known_mean(fit.seconds),
        }
        figures = {name: _rounded(value) for name, value in scores.items()}
        by_frame = {name: [_rounded(v) for v in values] for name, values in series.items()}
        rows[method] = json_finite({**figures, "by_frame": by_frame})
    return rows


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


Cells = Mapping[str, Mapping[str, Mapping[str, Any]]]


def mean_scores(cells: Cells, method: str) -> dict[str, float]:
    """Return the mean of each score of a method over the cells that have it."""
    rows = [
        {name: np.nan if v is None else v for name, v in cell[method].items()}
        for cell in cells.values()
    ]
    return {name: known_mean([row[name] for row in rows]) for name in rows[0] if name != "by_frame"}


def field_table(cells: Cells) -> str:
    """Return the scores at the most epochs in Markdown: means over the clips, and the spread over
    the fits of some.
    """
    names = next(iter(cells.values()))
    most = max(int(name.split("/")[1]) for name in names)
    rows = []
    for method in dict.fromkeys(name.split("/")[0] for name in names):
        scores = [
            {"fit": cell.split("/")[1], **by_name[f"{method}/{most}"]}
            for cell, by_name in cells.items()
        ]
        rows += means_over(scores, "fit", method=f"`{method}`")
    return scores_table(rows, {"method": "method"}, COLUMNS)


def plot_field(cells: Cells, path: Path) -> None:
    """Plot the errors of the methods over the frames, and over the bytes of a frame; means over the
    cells.

    Raises:
        OSError: the file cannot be written.
        ValueError: matplotlib is not installed.
    """
    names = list(next(iter(cells.values())))
    methods = list(dict.fromkeys(n.split("/")[0] for n in names))
    most = max(int(n.split("/")[1]) for n in names)
    figure = blank_figure(11, 7)
    axes = figure.subplots(2, 2)
    for k, method in enumerate(methods):
        style = {"color": f"C{k % 10}", "linestyle": "--" if k >= 10 else "-", "label": method}
        style |= {"linewidth": 2.2 if method == DEFAULT else 1.2}
        for axis, (score, title) in zip(axes[0], _PLOTTED, strict=True):
            series = [cell[f"{method}/{most}"]["by_frame"][score] for cell in cells.values()]
            values = np.nanmean(np.array(series, float), axis=0)
            axis.plot(range(1, len(values) + 1), values, **style)
            axis.set(
                xlabel=f"frame ({most} epochs)", ylabel=title, xticks=range(1, len(values) + 1)
            )
        for axis, (score, title) in zip(axes[1], _PLOTTED, strict=True):
            means = [mean_scores(cells, name) for name in names if name.split("/")[0] == method]
            axis.plot(
                [s["num_bytes"] / 1000 for s in means],
                [s[score] for s in means],
                marker="o",
                **style,
            )
            axis.set(xlabel="kB per later frame (by epochs)", ylabel=title)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    cells = {}
    for name, args in options.cells().items():
        cells[name] = measure(*args)
        print(f"{name} is done", flush=True)
    print(field_table(cells))
    if options.plot is not None:
        plot_field(cells, options.plot)
    settings = {
        name: getattr(options, name) for name in ("downscale", "frames", "epochs", "num_gaussians")
    }
    options.write({**settings, "cells": cells}, unprinted=["cells"])


if __name__ == "__main__":
    main(tyro.cli(Options))
