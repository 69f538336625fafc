"""Held-out quality of the first frame over processor time, as it is now and as it was before it followed the capture.

    python -m benchmarks.reports.quality_over_time --captures PHOTOS... --json out.json --plot out.png

The captures are those of `priors`. Before, all captures had 20,000 Gaussians and nothing against overfitting, and
fewer than 100 triangulated points were replaced by random ones. Every point of a curve is a fit of its own, with so
many steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.few_views import with_points
from benchmarks.reports.plots import blank_figure, save_figure
from benchmarks.reports.priors import CaseOptions, measured
from morgs_mi.capture.capture import Capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig

SECONDS = (5, 10, 20, 50, 100, 200, 500)
"""Ticks of the plot."""


@dataclass(frozen=True)
class Options(CaseOptions):
    """Captures, work and output."""

    steps: tuple[int, ...] = (250, 500, 1000, 2000)
    """Numbers of steps."""
    plot: Path | None = None
    """Plot, .png or .svg; needs matplotlib."""


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
