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
from morgs_mi.platform.bounded import read_json

_SCORES = ("psnr", "psnr_matched", "psnr_moving", "psnr_still")


@dataclass(frozen=True)
class Options(Output):
    """Folders of fits, and output."""

    outs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of the fits, each with its eval.json."""

    def run(self) -> None:
        """Print the table, and write the scores."""
        fits = [scores_of(out) for out in self.outs]
        print(first_frames(fits))
        self.write({"fits": fits})


def scores_of(out: Path) -> dict[str, Any]:
    """Return the scores of a fit: its settings, the first frame by view, and all frames in the mean
    of the views.
    """
    result = read_json(out / "eval.json")
    report = read_json(out / "report.json")
    first = report["frames"][0]
    frames = []
    for frame, row in zip(result["frames"], report["frames"], strict=True):
        scores = {name: frame[name] for name in _SCORES}
        scores |= {"active": row["active"].get("gaussians"), "seconds": row["seconds"]}
        rounded = {n: None if v is None else round(v, 3) for n, v in scores.items()}
        frames.append(rounded | {"num_bytes": row["num_bytes"]})
    return {
        "recording": out.name,
        "training_views": len(report["train_views"]),
        "gaussians": first["num_gaussians"],
        "is_balanced": bool(first["validation"].get("exposure", {}).get("taken", False)),
        "views": {
            name: {key: round(scores[key], 3) for key in _SCORES[:2]}
            for name, scores in result["frames"][0]["views"].items()
        },
        "frames": frames,
    }


def first_frames(fits: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]] = ()) -> str:
    """Return the PSNR of each held-out view in the first frame as recorded, and the means with
    matched colours too; and the range of the means of `others`, fits with several seeds, which are
    named RECORDING-SEED.
    """
    rows = []
    means_of_seeds: dict[str, list[float]] = {}
    for fit in others:
        psnr = float(np.mean([scores["psnr"] for scores in fit["views"].values()]))
        means_of_seeds.setdefault(fit["recording"].rpartition("-")[0], []).append(psnr)
    for fit in fits:
        views = fit["views"].values()
        cells = f"{fit['training_views']}", f"{fit['gaussians']:,}"
        balance = "yes" if fit["is_balanced"] else "no"
        psnrs = ", ".join(f"{scores['psnr']:.1f}" for scores in views)
        means = (f"{np.mean([scores[key] for scores in views]):.2f}" for key in _SCORES[:2])
        seeds = means_of_seeds.get(fit["recording"], [])
        spread = f"{min(seeds):.2f} to {max(seeds):.2f}" if seeds else "-"
        rows.append((fit["recording"], *cells, balance, psnrs, *means, spread))
    titles = "training views", "Gaussians", "balanced", "held-out views, dB"
    return markdown(("recording", *titles, "mean", "matched", "three seeds"), rows, left=1)


if __name__ == "__main__":
    tyro.cli(Options).run()
