"""Number of Gaussians and steps of the first frame: chosen from the capture, against fixed ones.

    python -m benchmarks.reports.first_frame --seeds 6 7 8 --captures CAPTURE --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`; of further captures, reduced by `--downscale`,
no view is held out. The probability of dropping is chosen as by default.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.few_views import with_points
from benchmarks.reports.fits import first_frame, random_capture
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.fit.config import FitConfig


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips and output."""

    seeds: tuple[int, ...] = (6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    captures: tuple[Path, ...] = ()
    """Further captures without points."""
    downscale: float = 4
    """Factor by which these are reduced."""
    gaussians: int = 20_000
    """Fixed number of Gaussians."""
    steps: int = 1500
    """Fixed number of steps."""
    compare: bool = True
    """Whether to fit with the fixed numbers too."""
    dropping: tuple[float, ...] = ()
    """Probability of dropping of each clip; none: chosen."""


def measure(source: Source, stereo: bool, fit: FitConfig) -> dict[str, float]:
    """Fit the first frame and return its size, its steps, its time, and the PSNR of trained and held-out views.

    Args:
        source: the capture.
        stereo: whether to start from points from stereo in place of the capture's own.
        fit: settings.
    """
    capture = source.open()
    train = capture.train_views
    if stereo:
        capture = with_points(capture, train, "stereo")
    scores, report = first_frame(capture, train, replace(StreamConfig(), fit=fit))
    figures = {
        "gaussians": report.num_gaussians,
        "steps": report.steps,
        "seconds": round(report.seconds, 1),
        "training": round(float(scores[list(train)].mean()), 2),
    }
    if capture.test_view is not None:
        figures["held_out"] = round(float(scores[capture.test_view]), 2)
    return figures


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    captures = [(random_capture(options.clips, seed), False) for seed in options.seeds]
    captures += [(load_capture(path, options.downscale, None, 1), True) for path in options.captures]
    rows, cells = dict[str, dict[str, Any]](), {}
    for k, (capture, stereo) in enumerate(captures):
        chosen = FitConfig(dropping=options.dropping[k] if options.dropping else None)
        fixed = replace(chosen, num_gaussians=options.gaussians, first_frame_steps=options.steps)
        name = capture.path.name
        rows[name] = {"views": len(capture.train_views)}
        for how, fit in {"chosen": chosen, **({"fixed": fixed} if options.compare else {})}.items():
            cells[f"{name} {how}"] = Source.of(capture), stereo, fit
    for cell, found in options.run(measure, cells).items():
        name, _, how = cell.rpartition(" ")
        rows[name][how] = found
    options.write({"fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
