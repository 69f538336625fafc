"""Errors of the renderer in stiff and extreme cases, and fits of hard recordings.

    python -m benchmarks.reports.stability

writes `benchmarks/results/stability.json` and the plot of the page docs/experiments/stability.md;
`python -m benchmarks.pages` writes its table.

The cases are shared with the tests (`tests.scenes.extremes`, `tests.scenes.hard_fits`). Image and
gradients are compared with a reference in extended precision, a million Gaussians with
`morgs_mi.evaluate.accuracy`. A row has its `kind` and `name`, the errors of the image and of the
gradient by attribute, the seconds of an image with its gradients after a warm-up, and the condition
number, if it is one of a ladder; or the PSNR of the first and the last frame of a fit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from benchmarks.reports.plots import blank_figure, grouped, markdown, save_figure
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from tests.render.exact import ATTRIBUTES, errors, run
from tests.scenes.extremes import (
    CASES_BY_KIND,
    DISTANCES,
    NEEDLES,
    million_on_a_pixel,
)
from tests.scenes.hard_fits import HARD_FITS, fitted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGES = Path(__file__).parents[2] / "docs/experiments"
RESULTS = Path(__file__).parents[1] / "results"
# Cases by condition number, label of the line and its colour, which the colour-blind distinguish.
_LADDERS = {
    "scales": (NEEDLES, "largest scale\nover smallest", "#0072B2"),
    "distance": (DISTANCES, "distance\nover extent", "#D55E00"),
}


@dataclass(frozen=True)
class Options(Output):
    """Measure errors in stiff and extreme cases, against extended precision."""

    json: Path | None = RESULTS / "stability.json"
    """JSON file for the rows."""
    plot: Path | None = PAGES / "stability.png"
    """Plot of the errors over condition numbers, .png or .svg; needs matplotlib."""

    def run(self) -> None:
        """Measure every case, print the table, and write the figures."""
        rows = list(_case_rows())
        start = time.perf_counter()
        row = {"kind": "million on a pixel", **million_on_a_pixel()}
        rows.append({**row, "seconds": time.perf_counter() - start})
        rows += _fit_rows()
        print(stability_table(rows))
        if self.plot is not None:
            save_figure(condition_plot(rows), self.plot)
        self.write({"rows": rows}, unprinted=["rows"])


def _case_rows() -> Iterator[Row]:
    conditions = {
        case.name: {ladder: condition}
        for ladder, (cases, *_) in _LADDERS.items()
        for condition, case in cases.items()
    }
    for kind, cases in CASES_BY_KIND.items():
        for case in cases:
            measured = errors(case)
            start = time.perf_counter()
            run(case.values, case.camera)
            seconds = time.perf_counter() - start
            row = {"kind": kind, "name": case.name, **measured, "seconds": seconds}
            if case.name in conditions:
                row["condition"] = conditions[case.name]
            yield row


def _fit_rows() -> Iterator[Row]:
    for fit in HARD_FITS:
        start = time.perf_counter()
        frames = list(fitted(fit))
        sentences = [status for *_, status in frames if status != "ok"]
        yield {
            "kind": "fit",
            "name": fit.name,
            "frames": len(frames),
            "psnr": [frames[0][0], frames[-1][0]],
            "finite": all(np.isfinite(v).all() for _, raw, _ in frames for v in raw.values()),
            "sentence": sentences[0] if sentences else "",
            "seconds": time.perf_counter() - start,
        }


def stability_table(rows: Sequence[Row]) -> str:
    """Return the largest errors of each kind of cases."""
    lines = []
    for (kind,), group in grouped(rows, "kind").items():
        if "image" in group[0]:
            image = max(row["image"] for row in group)
            gradients = (row.get(name, 0) for row in group for name in ATTRIBUTES)
            lines.append((kind, f"{image:.0e}", f"{max(gradients):.0e}"))
    return markdown(("kind", "image", "gradients"), lines)


def fits_table(rows: Sequence[Row]) -> str:
    """Return the PSNR of the first and the last frame of each hard recording, and what is said."""
    lines = []
    for row in rows:
        if row["kind"] == "fit":
            first, last = row["psnr"]
            sentence = row["sentence"].partition(";")[0] or "-"
            lines.append((row["name"], str(row["frames"]), f"{first:.1f}", f"{last:.1f}", sentence))
    columns = ("recording", "frames", "first, dB", "last, dB", "first status")
    return markdown(columns, lines)


def condition_plot(rows: Sequence[Row]) -> Figure:
    """Return the errors of image and worst gradient over the condition numbers."""
    figure = blank_figure(7.5, 4)
    axis = figure.subplots()
    measures: Sequence[tuple[str, Callable[[Row], float]]] = (
        ("-", lambda row: row["image"]),
        ("--", lambda row: max(row[name] for name in ATTRIBUTES)),
    )
    for ladder, (_, label, color) in _LADDERS.items():
        group = [row for row in rows if ladder in row.get("condition", {})]
        x = [row["condition"][ladder] for row in group]
        for style, error in measures:
            y = [error(row) for row in group]
            axis.loglog(x, y, style, color=color, marker="o", markersize=3)
        axis.annotate(
            label,
            (x[-1], y[-1]),
            xytext=(8, 0),
            color=color,
            textcoords="offset points",
            va="center",
        )
    axis.set(xlabel="condition number", ylabel="error: image (solid), worst gradient (dashed)")
    axis.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    tyro.cli(Options).run()
