"""The methods of other publications beside this package's, on one renderer, one codec and one
number of steps.

    python -m benchmarks.reports.field --seeds 16 17 18 --json out.json --plot out.png
    python -m benchmarks.reports.field --methods default --seeds 3 4 5 6 7 8 --epochs 2

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings
were chosen on seeds 0 to 2. All methods continue from the default's first frame of a clip. Image
and motion scores are means over the later frames of the held-out view, scores of tracks are over
the whole clip, all against the exact ground truth. A single method is shown clip by clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.field import anchors, hicom, motion_grid, rigidity, transformation_cache  # noqa: F401, they register models and terms
from benchmarks.reports.fits import DEFAULT, Clip, new_loop, random_capture
from benchmarks.reports.plots import (
    Column,
    blank_figure,
    grouped,
    means_over,
    save_figure,
    scores_table,
)
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from benchmarks.reports.tracks import track_scores
from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import coded_frames
from morgs_mi.evaluate.results import known_mean
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.platform.config import apply_values

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
_SCORES = ("psnr", "psnr_moving", "confidence_iou", "motion_error_moving")
_PSNR = (Column("PSNR, dB", "psnr", spread=False), Column("moving, dB", "psnr_moving"))
_MOTION = Column("motion error, px", "motion_error_moving", spread=False)
COLUMNS = (
    *_PSNR,
    _MOTION,
    Column("AJ, %", f"{_PROTOCOL} average_jaccard", 1, 100, spread=False),
    Column("MTE, %", f"{_PROTOCOL} median_error_percent", 1, spread=False),
    Column("kB", "num_bytes", 1, 1e-3, spread=False),
    Column("CPU s", "cpu_s", 1, spread=False),
)


@dataclass(frozen=True)
class Options(StudyOptions):
    """Clips, methods, work and output."""

    seeds: tuple[int, ...] = (16, 17, 18)
    """Seeds of the scenes."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Names of the methods."""
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

    def study(self) -> Study:
        """Return the study of the clips by each method and number of epochs."""
        scenes = []
        for seed in self.seeds:
            capture = random_capture(self.clips, seed, self.downscale)
            capture = replace(capture, num_frames=min(self.frames, capture.num_frames))
            first = self.settings_of(DEFAULT, self.epochs[0])
            scenes.append(Scene({"seed": seed}, (Clip.read(capture), first)))
        variants = [
            Variant({"method": method, "epochs": epochs}, self.settings_of(method, epochs))
            for epochs in self.epochs
            for method in self.methods
        ]
        return Study(measure, scenes, variants, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the scores by method, or the scores of a single method by clip."""
        return scenes_table(rows) if len(self.methods) == 1 else field_table(rows)

    def run(self) -> list[Row]:
        """Run the study, and draw the plot."""
        rows = super().run()
        if self.plot is not None:
            plot_field(rows, self.plot)
        return rows

    def settings_of(self, method: str, epochs: int) -> StreamConfig:
        """Return the settings of a method."""
        preset, values = METHODS[method]
        config = StreamConfig() if preset == DEFAULT else apply_preset(StreamConfig(), preset)  # pyright: ignore[reportArgumentType]
        config = apply_values(config, values)
        work = {
            "num_gaussians": self.num_gaussians,
            "first_frame_steps": self.first_frame_steps,
            "epochs": epochs,
        }
        return replace(config, fit=replace(config.fit, **work))


@cache
def first_frame(clip: Clip, config: StreamConfig) -> Packet:
    """Return the packet of the first frame of a clip, which all methods continue."""
    return new_loop(clip.capture, config).push(clip.images[0])[0]


def measure(clip: Clip, first: StreamConfig, config: StreamConfig) -> dict[str, Any]:
    """Fit the later frames of a clip and return their scores.

    Args:
        clip: the clip.
        first: settings of the first frame.
        config: settings of the later frames.
    """
    fit = clip.continued(first_frame(clip, replace(first, seed=config.seed)), config)
    tracks = track_scores(coded_frames(fit.packets), clip.capture, config.render)
    later_frames = fit.evaluation.frames[1:]
    series = {name: [getattr(row.scores, name) for row in later_frames] for name in _SCORES}
    return {
        **{name: known_mean(values) for name, values in series.items()},
        **{f"{_PROTOCOL} {name}": value for name, value in tracks.items()},
        "num_bytes": known_mean([report.num_bytes for report in fit.reports]),
        "cpu_s": known_mean(fit.seconds),
        "by_frame": series,
    }


def with_most_epochs(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the fits with the most epochs."""
    most = max(row["epochs"] for row in rows)
    return [row for row in rows if row["epochs"] == most]


def field_table(rows: Sequence[Row]) -> str:
    """Return the scores of each method at the most epochs in Markdown: means over the clips, and
    the spread over the fits of some.
    """
    means = []
    for (method,), group in grouped(with_most_epochs(rows), "method").items():
        means += means_over(group, "fit_seed", method=f"`{method}`")
    return scores_table(means, {"method": "method"}, COLUMNS)


def scenes_table(rows: Sequence[Row]) -> str:
    """Return the scores of each clip by one method, and of their means."""
    columns = (*_PSNR, Column("IoU of the confidence", "confidence_iou", spread=False), _MOTION)
    return scores_table(
        [*rows, *means_over(rows, "fit_seed", seed="mean")], {"seed": "seed"}, columns
    )


def plot_field(rows: Sequence[Row], path: Path) -> None:
    """Plot the errors of the methods over the frames, and over the bytes of a frame; means over the
    clips and their fits.

    Raises:
        OSError: the file cannot be written.
        ValueError: matplotlib is not installed.
    """
    figure = blank_figure(11, 7)
    axes = figure.subplots(2, 2)
    for k, ((method,), fits) in enumerate(grouped(rows, "method").items()):
        style = {"color": f"C{k % 10}", "linestyle": "--" if k >= 10 else "-", "label": method}
        style |= {"linewidth": 2.2 if method == DEFAULT else 1.2}
        longest = with_most_epochs(fits)
        means = [
            mean
            for count in grouped(fits, "epochs").values()
            for mean in means_over(count, "method")
        ]
        for column, (score, title) in zip(axes.T, _PLOTTED, strict=True):
            series = np.array([row["by_frame"][score] for row in longest], float)
            frames = range(1, series.shape[1] + 1)
            column[0].plot(frames, np.nanmean(series, axis=0), **style)
            column[0].set(
                xlabel=f"frame ({longest[0]['epochs']} epochs)", ylabel=title, xticks=frames
            )
            sizes = [mean["num_bytes"] / 1000 for mean in means]
            column[1].plot(sizes, [mean[score] for mean in means], marker="o", **style)
            column[1].set(xlabel="kB per later frame (by epochs)", ylabel=title)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)


if __name__ == "__main__":
    tyro.cli(Options).run()
