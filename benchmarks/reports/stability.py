"""Errors of the renderer in stiff and extreme cases, and fits of hard recordings.

    python -m benchmarks.reports.stability

writes `benchmarks/results/stability.json`; `python -m benchmarks.pages` writes the tables of
docs/experiments/stability.md.

The cases are shared with the tests (`tests.scenes.extremes`, `tests.scenes.hard_fits`). Image and
gradients are compared with a reference in extended precision, a million Gaussians with
`morgs_mi.evaluate.accuracy`. A row has its `kind` and `name`, the errors of the image and of the
gradient by attribute, and the seconds of an image with its gradients after a warm-up; or the PSNR
of the first and the last frame of a fit.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.reports.plots import grouped, markdown
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from tests.render.exact import ATTRIBUTES, errors, run
from tests.scenes.extremes import CASES_BY_KIND, million_on_a_pixel
from tests.scenes.hard_fits import HARD_FITS, fitted

RESULTS = Path(__file__).parents[1] / "results"


@dataclass(frozen=True)
class Options(Output):
    """Measure errors in stiff and extreme cases, against extended precision."""

    json: Path | None = RESULTS / "stability.json"
    """JSON file for the rows."""

    def run(self) -> None:
        """Measure every case, print the table, and write the rows."""
        rows = list(_case_rows())
        start = time.perf_counter()
        row = {"kind": "million on a pixel", **million_on_a_pixel()}
        rows.append({**row, "seconds": time.perf_counter() - start})
        rows += _fit_rows()
        print(stability_table(rows))
        self.write({"rows": rows}, unprinted=["rows"])


def _case_rows() -> Iterator[Row]:
    for kind, cases in CASES_BY_KIND.items():
        for case in cases:
            measured = errors(case)
            start = time.perf_counter()
            run(case.values, case.camera)
            seconds = time.perf_counter() - start
            yield {"kind": kind, "name": case.name, **measured, "seconds": seconds}


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


if __name__ == "__main__":
    tyro.cli(Options).run()
