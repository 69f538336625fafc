"""Held-out views of recordings: the scores that `morgs-mi eval` wrote for fits at the settings of
the commands.

    morgs-mi fit RECORDING OUT
    morgs-mi eval OUT --json OUT/eval.json
    python -m benchmarks.reports.held_out OUT ... --json held_out.json

Each folder OUT has the name of its recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.reports.plots import markdown
from benchmarks.speed.output import Output
from morgs_mi.core.bounded import read_json

# Frames of a table over time at equal distances, besides the first residual.
_ROWS = 3


@dataclass(frozen=True)
class Options(Output):
    """Folders of fits, and output."""

    outs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of the fits, each with its eval.json."""

    def run(self) -> None:
        """Print the tables, and write the scores."""
        fits = [scores_of(out) for out in self.outs]
        print(first_frames(fits))
        print(later_frames(fits))
        self.write({"fits": fits})


def scores_of(out: Path) -> dict[str, Any]:
    """Return the scores of a fit: its settings, the first frame by view, and all frames in the mean
    of the views.
    """
    result = read_json(out / "eval.json")
    report = read_json(out / "report.json")
    first = report["frames"][0]
    frames = result["frames"]
    return {
        "recording": out.name,
        "training_views": len(report["train_views"]),
        "gaussians": first["num_gaussians"],
        "is_balanced": bool(first["validation"].get("exposure", {}).get("taken", False)),
        "views": {
            name: {key: round(scores[key], 3) for key in ("psnr", "psnr_matched")}
            for name, scores in frames[0]["views"].items()
        },
        "frames": [
            {
                "psnr": _rounded(frame["psnr"]),
                "psnr_matched": _rounded(frame["psnr_matched"]),
                "psnr_moving": _rounded(frame["psnr_moving"]),
                "psnr_still": _rounded(frame["psnr_still"]),
                "active": _rounded(row["active"].get("gaussians")),
                "num_bytes": row["num_bytes"],
                "seconds": _rounded(row["seconds"]),
            }
            for frame, row in zip(frames, report["frames"], strict=True)
        ],
    }


def first_frames(fits: Sequence[dict[str, Any]]) -> str:
    """Return the PSNR of each held-out view in the first frame as recorded, and the means with
    matched colours too.
    """
    rows = []
    for fit in fits:
        balance = "yes" if fit["is_balanced"] else "no"
        views = fit["views"].values()
        cells = f"{fit['training_views']}", f"{fit['gaussians']:,}", balance
        psnrs = ", ".join(f"{scores['psnr']:.1f}" for scores in views)
        means = (
            f"{np.mean([scores[key] for scores in views]):.2f}" for key in ("psnr", "psnr_matched")
        )
        rows.append((fit["recording"], *cells, psnrs, *means))
    titles = "training views", "Gaussians", "balanced", "held-out views, dB", "mean", "matched"
    return markdown(("recording", *titles), rows, left=1)


def later_frames(fits: Sequence[dict[str, Any]]) -> str:
    """Return the scores of some frames of the recordings that have several."""
    rows = []
    for fit in fits:
        frames = fit["frames"]
        if len(frames) == 1:
            continue
        for index in sorted({0, 1, *np.linspace(0, len(frames) - 1, _ROWS, dtype=int).tolist()}):
            frame = frames[index]
            scores = (
                _cell(frame[key], 2)
                for key in ("psnr", "psnr_matched", "psnr_moving", "psnr_still")
            )
            active = "" if frame["active"] is None else f"{100 * frame['active']:.0f} %"
            size = f"{frame['num_bytes'] / 1e3:.0f}"
            rows.append(
                (fit["recording"], f"{index}", *scores, active, size, _cell(frame["seconds"], 1))
            )
    titles = "PSNR, dB", "matched", "moving", "still", "active Gaussians", "kB", "s"
    return markdown(("recording", "frame", *titles), rows, left=1)


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


if __name__ == "__main__":
    tyro.cli(Options).run()
