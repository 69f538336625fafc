"""Held-out quality of the first frame over processor time, as it is now and as it was before it followed the capture.

    python -m benchmarks.reports.quality_over_time --captures PHOTOS... --json out.json --plot out.png

The synthetic captures are `morgs-mi synth random` with as many training views as the case says, spread over the rig,
and points from stereo. Of other captures, every fifth view is held out. Before, all captures had 20,000 Gaussians
and nothing against overfitting, and fewer than 100 triangulated points were replaced by random ones. Every point of a
curve is a fit of its own, with so many steps.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.few_views import spread_views, with_points
from benchmarks.reports.fits import first_frame
from benchmarks.reports.plots import blank_figure, save_figure
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

CASES = ((20, 16, 0.0), (21, 8, 0.0), (22, 4, 0.0), (23, 16, 0.02), (24, 8, 0.02), (25, 4, 0.02))
"""Seed of the scene, number of training views, and noise of the reduced images relative to white."""

Points = tuple[np.ndarray, np.ndarray]
SECONDS = (5, 10, 20, 50, 100, 200, 500)
"""Ticks of the plot."""


@dataclass(frozen=True)
class CaseOptions(CellOptions):
    """Captures and their sizes."""

    captures: tuple[Path, ...] = ()
    """Further captures."""
    synthetic: tuple[int, ...] = tuple(seed for seed, _, _ in CASES)
    """Seeds of the synthetic captures."""
    clips: Path = Path("out/first_frames")
    """Folder of the synthetic captures, which are made where they are missing."""
    downscale: float = 2
    """Factor by which the synthetic captures are reduced."""
    width: int = 160
    """Width to which the other captures are reduced by a whole factor, px."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits."""

    def cases(self) -> Iterator[tuple[str, Capture, tuple[int, ...]]]:
        """Yield the name, the capture with the points of its training views, and these views."""
        for seed, count, noise in CASES:
            if seed not in self.synthetic:
                continue
            clip = self.clips / f"{seed}-{count}-{noise * self.downscale:g}"
            if not clip.exists():
                # The mean over a block has less noise than its pixels.
                noise_of_pixels = noise * self.downscale
                synthesize("random", clip, SynthConfig(cameras=20, frames=1, noise=noise_of_pixels, seed=seed))
            capture = load_capture(clip, self.downscale)
            train = spread_views(capture.cameras, count, capture.train_views)
            yield f"{count} views{', noisy' if noise else ''}", with_points(capture, train, "stereo"), train
        for path in self.captures:
            widest = max(camera.width for camera in load_capture(path).cameras)
            capture = load_capture(path, max(widest // self.width, 1))
            train = tuple(v for v in range(len(capture.cameras)) if v % 5 != 2)
            enough = len(capture.points) >= 100
            yield path.name, capture if enough else with_points(capture, train, "stereo"), train


@dataclass(frozen=True)
class Options(CaseOptions):
    """Captures, work and output."""

    steps: tuple[int, ...] = (250, 500, 1000, 2000)
    """Numbers of steps."""
    plot: Path | None = None
    """Plot, .png or .svg; needs matplotlib."""


def measured(source: Source, train: Sequence[int], points: Points, config: StreamConfig) -> dict[str, float]:
    """Return the mean PSNR of held-out and training views, the processor time, and how many Gaussians and steps."""
    capture = replace(source.open(), points=points[0], point_colors=points[1])
    start = time.process_time()
    scores, report = first_frame(capture, train, config)
    return {
        "held_out": round(float(np.delete(scores, train).mean()), 3),
        "training": round(float(scores[list(train)].mean()), 3),
        "cpu_s": round(time.process_time() - start, 2),
        "gaussians": report.num_gaussians,
        "steps": report.steps,
    }


def configured(how: str, steps: int, seed: int) -> StreamConfig:
    """Return the settings of a fit, before or now."""
    config = StreamConfig(seed=seed)
    fit = replace(config.fit, first_frame_steps=steps)
    if how == "before":
        fit = replace(fit, num_gaussians=20_000, dropping=0.0, noise_aware=False)
    return replace(config, fit=fit)


def as_before(capture: Capture, train: tuple[int, ...], own_points: bool) -> Capture:
    """Return the capture with the points that it had before."""
    if own_points:
        return capture
    found = with_points(capture, train, "triangulated")
    return found if len(found.points) >= 100 else with_points(capture, train, "random")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw a panel per capture: mean of the fits, and their range."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    columns = 3
    figure = blank_figure(9, 2.4 * -(-len(cases) // columns))
    panels = figure.subplots(-(-len(cases) // columns), columns, squeeze=False).ravel()
    for panel, case in zip(panels, cases, strict=False):
        for how, color in (("before", "tab:grey"), ("now", "tab:blue")):
            own = [row for row in rows if (row["case"], row["how"]) == (case, how)]
            steps = sorted({row["planned"] for row in own})
            fits = [[row for row in own if row["planned"] == count] for count in steps]
            seconds = [np.mean([row["cpu_s"] for row in each]) for each in fits]
            held_out = np.array([[row["held_out"] for row in each] for each in fits])
            panel.plot(seconds, held_out.mean(axis=1), "o-", color=color, label=how, markersize=3)
            panel.fill_between(seconds, held_out.min(axis=1), held_out.max(axis=1), color=color, alpha=0.2)
        panel.set_title(case, fontsize=8)
        panel.set(xscale="log")
        panel.set_xticks(SECONDS, [f"{seconds:g}" for seconds in SECONDS])
        panel.minorticks_off()
        panel.set_xlim(0.8 * min(row["cpu_s"] for row in rows), 1.2 * max(row["cpu_s"] for row in rows))
        panel.tick_params(labelsize=7)
    for panel in panels[len(cases) :]:
        panel.set_axis_off()
    panels[0].legend(fontsize=7)
    figure.supxlabel("processor time, s", fontsize=8)
    figure.supylabel("held-out PSNR, dB", fontsize=8)
    save_figure(figure, path)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    about, cells = {}, {}
    for case, capture, train in options.cases():
        own_points = case in {path.name for path in options.captures} and len(capture.points) >= 100
        given = {"now": capture, "before": as_before(capture, train, own_points)}
        for how, steps, seed in product(given, options.steps, options.fit_seeds):
            points = given[how].points, given[how].point_colors
            name = f"{case}; {how}; {steps}; {seed}"
            cells[name] = Source.of(capture), train, points, configured(how, steps, seed)
            about[name] = {"case": case, "how": how, "planned": steps, "seed": seed}
    rows = [{**about[name], **row} for name, row in options.run(measured, cells).items()]
    if options.plot is not None:
        draw(rows, options.plot)
    options.write({"downscale": options.downscale, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
