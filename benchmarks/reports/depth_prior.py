"""Depth as a prior of the first frame: held-out PSNR with and without it, for depth of several qualities.

    python -m benchmarks.reports.depth_prior --seeds 16 17 18 --fit-seeds 0 1 2 --json out.json

Each seed gives a clip of `morgs-mi synth random`, of which some cameras that are spread over the rig are trained on and
all others are held out. In place of a network, the exact inverse depth of the path tracer is changed: by an unknown
scale and shift per view, and by a smooth error, in standard deviations of the view's inverse depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.few_views import Points, spread_views, with_points
from benchmarks.reports.fits import random_capture
from benchmarks.reports.plots import grouped, markdown, plus_minus
from morgs_mi.capture.capture import Capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.core.camera import Camera
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import mean_psnr
from morgs_mi.fit.depth_prior import depth_prior
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.initialise import fill_points, from_points, resample_points, scene_extent, seed_points
from morgs_mi.fit.view import View
from morgs_mi.losses.ssim import Target
from morgs_mi.render.config import RenderConfig
from morgs_mi.synth.ground_truth import load_truth

# Cells of the grid across a view on which the smooth error is drawn.
_CELLS = 6


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (16, 17, 18)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each scene, and of its noise and errors."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    views: int = 4
    """Training views."""
    points: Points = "stereo"
    """Points that the first frame starts from: triangulated and from stereo, triangulated, or random."""
    errors: tuple[float, ...] = (0.0, 0.1, 0.3)
    """Standard deviations of the smooth error of the depth, relative to those of the view's inverse depth."""
    weights: tuple[float, ...] = (0.1,)
    """Weights of the prior."""
    noise: float = 0.0
    """Noise that is added to the training views, relative to white."""
    dropping: float = 0.0
    """Probability of dropping."""
    downscale: float = 4
    """Factor by which the clips are reduced."""
    steps: int = 500
    """Steps of the first frame."""
    gaussians: int = 4000
    """Number of Gaussians."""


def estimated(depth: np.ndarray, error: float, rng: np.random.Generator) -> np.ndarray:
    """Return what a network would return for an exact depth [H, W]: with a scale, a shift and a smooth error."""
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    smooth = cv2.resize(rng.normal(size=(_CELLS, _CELLS)), depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    relative = inverse + error * inverse.std() * smooth / smooth.std()
    return rng.uniform(1, 20) * relative + rng.uniform(-1, 1)


def exact_depth(capture: Capture, camera: Camera) -> np.ndarray:
    """Return the exact depth of a view in the first frame at the size of the camera."""
    assert capture.truth is not None
    depth = load_truth(capture.truth, camera.name, 0).depth
    return cv2.resize(depth, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)


def measure(source: Source, seed: Sequence[int], options: Options) -> list[dict[str, Any]]:
    """Return the mean PSNR of the training views and of the held-out ones, without a prior and with each."""
    capture = source.open()
    every, config = range(len(capture.cameras)), FitConfig()
    train = spread_views(capture.cameras, options.views, capture.train_views)
    capture = with_points(capture, train, options.points)
    cameras, rng = [capture.cameras[v] for v in train], np.random.default_rng(seed)
    images = list(next(capture.frames(0, 1)).images)
    given = [
        np.clip(images[v] + rng.normal(0, 255 * options.noise, images[v].shape), 0, 255).astype(np.uint8) for v in train
    ]
    depths = [exact_depth(capture, camera) for camera in cameras]
    config = replace(
        config, num_gaussians=options.gaussians, first_frame_steps=options.steps, dropping=options.dropping
    )
    masks = [None] * len(train)
    if len(capture.points):
        start = fill_points(capture.points, capture.point_colors, cameras, given, masks, config.first_count, rng)
    else:
        start = seed_points(cameras, given, masks, config.first_count, rng)
    start = from_points(*resample_points(*start, config.first_count, rng), config.sh_degree, config.initial_opacity)
    targets, rows = [Target(image) for image in given], []
    for error, weight in [(None, 0.0), *((e, w) for e in options.errors for w in options.weights)]:
        prior = None
        if error is not None:
            maps = [estimated(depth, error, np.random.default_rng([*seed, k])) for k, depth in enumerate(depths)]
            prior = depth_prior(maps, cameras, capture.points)
        fitted = fit_first_frame(
            start,
            cameras,
            targets,
            scene_extent(cameras),
            replace(config, depth_weight=weight),
            RenderConfig(),
            np.random.default_rng(seed),
            prior=prior,
        )
        scores = {
            name: mean_psnr(fitted.gaussians, [View(capture.cameras[v], images[v]) for v in views], RenderConfig())
            for name, views in (("training", train), ("held_out", [v for v in every if v not in train]))
        }
        rows.append({"error": error, "weight": weight, **{n: round(s, 2) for n, s in scores.items()}})
    return rows


def errors_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the held-out PSNR of each scene by the error of the depth, in Markdown."""
    seeds, rows = list(dict.fromkeys(fit["seed"] for fit in fits)), []
    for (error,), own in grouped(fits, "error").items():
        psnrs = ([fit["held_out"] for fit in each] for each in grouped(own, "seed").values())
        name = "no prior" if error is None else f"{error:g}"
        rows.append((name, *(f"{plus_minus(values)} dB" for values in psnrs)))
    return markdown(("error of the depth", *(f"seed {seed}" for seed in seeds)), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    about, cells = {}, {}
    for seed, fit_seed in product(options.seeds, options.fit_seeds):
        name = f"seed {seed}, fit {fit_seed}"
        about[name] = {"seed": seed, "fit_seed": fit_seed}
        source = Source.of(random_capture(options.clips, seed, options.downscale))
        cells[name] = source, (seed, fit_seed), options
    rows = [{**about[name], **row} for name, found in options.run(measure, cells).items() for row in found]
    kept = ("views", "points", "noise", "dropping", "downscale", "steps", "gaussians")
    options.write({**{name: getattr(options, name) for name in kept}, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
