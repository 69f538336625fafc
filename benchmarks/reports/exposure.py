"""Exposures that differ and change: their cost, and the gain by estimating them in the fit.

    python -m benchmarks.reports.exposure --seeds 3 4 --json out.json

Each scene is `morgs-mi synth random --seed SEED`, recorded twice: by equal cameras, and by cameras with exposures that
differ, drift and vary from frame to frame. Both are fitted with `fit.exposure` off and auto. The exposure of the
held-out view is right. Scores are means over all its frames: as recorded, and after the gain and bias per channel that
fit best, because only differences between cameras are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import ClipOptions, new_loop
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi import rasterize
from morgs_mi.capture.truth import load_truth
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.temporal import StillVariation
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import follow_exposure
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.synth.disturbances import Disturbances

CAMERAS = {
    "equal": Disturbances(),
    "disturbed": Disturbances(exposure_gain=0.2, exposure_drift=0.15, exposure_flicker=0.02),
}
COLUMNS = (
    Column("as recorded", "psnr", unit=" dB"),
    Column("colours matched", "psnr_matched", unit=" dB"),
    Column("still: mTV x100", "mtv", 3, spread=False),
    Column("kB per later frame", "kb", 1, spread=False),
)


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each scene."""

    def study(self) -> Study:
        """Return the study of both kinds of cameras, with and without exposures in the fit."""
        scenes = []
        for seed, (name, own) in product(self.seeds, CAMERAS.items()):
            clip = self.clip("random", f"random-{seed}-{name}", cameras=7, disturbances=own, seed=seed)
            scenes.append(Scene({"seed": seed, "cameras": name}, (Source.of(clip),)))
        modes = [Variant({"exposure": mode}, self.config(exposure=mode, dropping=0.0)) for mode in ("off", "auto")]
        return Study(measure, scenes, modes, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the scores of each scene by its cameras and by `fit.exposure`."""
        return scores_table(rows, {"seed": "seed", "cameras": "cameras", "`fit.exposure`": "exposure"}, COLUMNS, left=7)


def measure(source: Source, config: StreamConfig) -> dict[str, Any]:
    """Return the scores of a fit."""
    capture = source.open()
    test = capture.reference_view
    loop = new_loop(capture, config)
    rows = []
    still = StillVariation(None, 0)
    assert capture.truth is not None
    camera, reports = capture.cameras[test], []
    for frame in capture.frames():
        reports.append(loop.push([frame.images[v] for v in capture.train_views])[1])
        assert loop.gaussians is not None
        color, target = np.asarray(rasterize(loop.gaussians, camera, ("color",)).color), frame.images[test]
        image, recorded = to_uint8(color), target / 255.0
        matched = follow_exposure(image, target)(image / 255.0).clip(0, 1)
        rows.append((psnr(image / 255.0, recorded), psnr(matched, recorded)))
        still.add(image, target, load_truth(capture.truth, camera.name, frame.index).mask)
    psnrs = dict(zip(("psnr", "psnr_matched"), np.mean(rows, axis=0), strict=True))
    kb = np.mean([report.num_bytes for report in reports[1:]]) / 1e3
    return {**psnrs, "kb": kb, "mtv": still.result().render, "seconds": reports[0].seconds}


if __name__ == "__main__":
    tyro.cli(Options).run()
