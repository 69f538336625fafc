"""First frames of clips that no setting was chosen on: quality of the held-out views, and the time.

    python -m benchmarks.reports.generalise --scenes random-201 random-202 random-203 spheres --json out.json

Each clip is the first frame of `morgs-mi synth SCENE --cameras 10` without sensor noise; random-N has the seed N. Some
cameras that are spread over the rig are trained on, with sensor noise, and all others are held out, without noise.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import new_loop, spread_views, synthetic
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi.capture.capture import Capture
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.synth.synth_config import SynthConfig

COLUMNS = (
    Column("held-out views", "held_out", unit=" dB"),
    Column("processor time", "cpu_s", 0, unit=" s"),
)
_CAMERAS = 10


@dataclass(frozen=True)
class Options(StudyOptions):
    """Clips and output."""

    scenes: tuple[str, ...] = ("random-201", "random-202", "random-203", "spheres")
    """Scenes of the package; random-N is the random one of the seed N."""
    clips: Path = Path("out/first_frames")
    """Folder of the clips, which are made where they are missing."""
    views: tuple[int, ...] = (9, 4)
    """Numbers of training views."""
    noises: tuple[float, ...] = (0.0, 0.02)
    """Standard deviations of the sensor noise of the training views, relative to white."""
    gaussians: int | None = None
    """Number of Gaussians; default: by the detail of the images."""
    steps: int | None = None
    """Steps of the first frame; default: until it has converged."""

    def study(self) -> Study:
        """Return the study of the clips."""
        scenes = []
        for name in self.scenes:
            scene, _, seed = name.partition("-")
            config = SynthConfig(cameras=_CAMERAS, frames=1, noise=0.0, seed=int(seed or 0))
            capture = synthetic(scene, self.clips / name, config)
            for views in self.views:
                train = spread_views(capture.cameras, views, capture.train_views)
                for noise in self.noises:
                    keys = {"clip": name, "views": views, "noise": noise}
                    scenes.append(Scene(keys, (Source.of(capture), train, noise)))
        fit = FitConfig(num_gaussians=self.gaussians, first_frame_steps=self.steps)
        variants = [Variant({"variant": "default"}, StreamConfig(fit))]
        return Study(measure, scenes, variants, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the quality and the time of each clip and variant."""
        return scores_table(rows, {name: name for name in ("clip", "views", "noise", "variant")}, COLUMNS)


def measure(source: Source, train: Sequence[int], noise: float, config: StreamConfig) -> dict[str, Any]:
    """Fit the first frame; return the PSNR of held-out and training views, and the work."""
    capture = source.open()
    images = next(capture.frames(0, 1)).images
    loop = new_loop(capture, config, train)
    start = time.process_time()
    _, report = loop.push([_noisy(images[v], noise, v) for v in train])
    seconds = time.process_time() - start
    return {
        "held_out": _psnr(loop.gaussians, capture, images, sorted({*range(len(images))} - {*train})),
        "training": _psnr(loop.gaussians, capture, images, train),
        "steps": report.steps,
        "gaussians": report.num_gaussians,
        "cpu_s": seconds,
    }


def _psnr(gaussians: Any, capture: Capture, images: Sequence[np.ndarray], views: Sequence[int]) -> float:
    """Return the mean PSNR of some views without noise, dB."""
    compared = [View(capture.cameras[v], images[v], capture.masks[v]) for v in views]
    return mean_psnr(gaussians, compared, RenderConfig())


def _noisy(image: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """Return an image with sensor noise, relative to white."""
    grain = 255 * noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)


if __name__ == "__main__":
    tyro.cli(Options).run()
