"""Priors of the first frame: held-out views of captures of all kinds with each, and without.

    python -m benchmarks.reports.priors --captures PHOTOS... --json out.json

The synthetic cases are `morgs-mi synth random` with as many training views as the case says, spread over the rig, and
points from stereo. Of other captures, every fifth view is held out. Only dropping and the weight of D-SSIM are settings
of the package; the other priors are patched into the fit here:

    penalties     0.01 mean(opacity) + 0.01 mean(scale / extent), as 3DGS-MCMC has them
    needles       mean(log(longest axis / (3 middle axis))), where that is positive
    exploration   noise of the means of nearly transparent Gaussians in every step, as 3DGS-MCMC has it
    smooth depth  0.1 mean|second derivative of the inverse depth|, falling to 0 over the steps
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro
from scipy.special import expit

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.few_views import spread_views, with_points
from benchmarks.reports.fits import first_frame
from morgs_mi import stream_loop
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Tensor
from morgs_mi.fit import first_frame as first
from morgs_mi.fit.optimise import replace_parameter
from morgs_mi.render.rasterize import Image
from morgs_mi.synth.synthesize import synthesize

CASES = ((20, 16, 0.0), (21, 8, 0.0), (22, 4, 0.0), (23, 16, 0.02), (24, 8, 0.02), (25, 4, 0.02))
"""Seed of the scene, number of training views, and noise of the reduced images relative to white."""

Points = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CaseOptions(CellOptions):
    """Captures and their sizes."""

    captures: tuple[Path, ...] = ()
    """Further captures."""
    synthetic: tuple[int, ...] = tuple(seed for seed, _, _ in CASES)
    """Seeds of the synthetic captures."""
    clips: Path = Path("out/priors")
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
                synthesize("random", clip, num_cameras=20, num_frames=1, noise=noise_of_pixels, seed=seed)
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
    """Captures, priors and work."""

    priors: tuple[str, ...] = (
        "none",
        "dropping",
        "no D-SSIM",
        "penalties",
        "needles",
        "exploration",
        "smooth depth",
    )
    """Priors that are compared."""
    steps: int = 600
    """Steps of the first frame."""
    gaussians: int = 5000
    """Number of Gaussians."""


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


def measure(source: Source, train: Sequence[int], points: Points, config: StreamConfig, prior: str) -> dict[str, float]:
    """Return what `measured` returns, with a prior."""
    with _PATCHES[prior]() if prior in _PATCHES else ExitStack():
        return measured(source, train, points, config)


def configured(options: Options, prior: str, seed: int) -> StreamConfig:
    """Return the settings of a fit with a prior."""
    config = StreamConfig(seed=seed)
    fit = replace(
        config.fit,
        first_frame_steps=options.steps,
        num_gaussians=options.gaussians,
        dropping=0.2 if prior == "dropping" else 0.0,
        depth_weight=0.1,
    )
    if prior == "no D-SSIM":
        fit = replace(fit, objective=replace(fit.objective, dssim_weight=0.0))
    return replace(config, fit=fit)


@contextmanager
def _penalised(penalty: Callable[[Gaussians], Tensor]) -> Iterator[None]:
    """Add a penalty of the Gaussians of each step to L_recon."""
    drawn: list[Gaussians] = []
    dropped, recon_loss = first.dropped, first.recon_loss

    def noted(gaussians: Gaussians, *args: Any) -> Gaussians:
        drawn[:] = [gaussians]
        return dropped(gaussians, *args)

    def penalised(*args: Any) -> Tensor:
        return recon_loss(*args) + penalty(drawn[0])

    with patch.object(first, "dropped", noted), patch.object(first, "recon_loss", penalised):
        yield


def size_and_opacity(gaussians: Gaussians) -> Tensor:
    means = np.asarray(dr.detach(gaussians.means))
    extent = float(np.linalg.norm(np.percentile(means, 95, axis=0) - np.percentile(means, 5, axis=0))) / 2
    return 0.01 * dr.mean(gaussians.opacities.array) + 0.01 / extent * dr.mean(gaussians.scales.array)


def needles(gaussians: Gaussians) -> Tensor:
    count = len(gaussians)
    a, b, c = (dr.gather(mi.Float, gaussians.log_scales.array, 3 * dr.arange(mi.UInt32, count) + k) for k in range(3))
    longest = dr.maximum(dr.maximum(a, b), c)
    middle = a + b + c - longest - dr.minimum(dr.minimum(a, b), c)
    return dr.mean(dr.maximum(longest - middle - float(np.log(3)), 0))


@contextmanager
def _exploring() -> Iterator[None]:
    """Move nearly transparent Gaussians at random after every step (Kheradmand et al. 2024)."""
    optimise = first.optimise

    def exploring(optimizer: Any, rates: Any, views: Any, losses_at: Any, *args: Any) -> dict[str, float]:
        decay, on_step, start, last = args[1:]
        rng, losses = np.random.default_rng(start), {}
        for step, view in enumerate(views, start):
            losses = optimise(optimizer, rates, [view], losses_at, {}, decay, on_step, step, last)
            means, opacity = np.asarray(optimizer["means"]), expit(np.asarray(optimizer["logit_opacities"]))
            gate = expit(100 * (0.005 - opacity))
            variance = np.exp(2 * np.asarray(optimizer["log_scales"])).mean(axis=1)
            size = 5e5 * 1.6e-4 * decay(step) * gate * variance
            noise = size[:, None] * rng.standard_normal(means.shape)
            replace_parameter(optimizer, "means", (means + noise).astype(np.float32), lambda moment: moment)
        return losses

    with patch.object(first, "optimise", exploring):
        yield


class _Smooth:
    """Stands in for the inverse depth of a view in `fit_first_frame`."""

    def loss(self, image: Image) -> Tensor:
        height, width = image.depth.shape[:2]
        depth = image.depth.array
        inverse = dr.select(depth > 0, dr.rcp(dr.maximum(depth, 1e-6)), 0)
        x, y = (a.ravel() for a in np.meshgrid(np.arange(1, width - 1), np.arange(1, height - 1)))
        total = mi.Float(0)
        for offset in (1, width):
            here = from_numpy(mi.UInt32, (y * width + x).astype(np.uint32))
            at = [dr.gather(mi.Float, inverse, here + shift - offset) for shift in (0, offset, 2 * offset)]
            total = total + dr.mean(dr.abs(at[0] - 2 * at[1] + at[2])) / dr.mean(dr.detach(inverse))
        return total


@dataclass(frozen=True)
class _SmoothDepth:
    """Stands in for a `DepthPrior`."""

    aligned: tuple[_Smooth, ...]

    def realigned(self, *_: Any) -> _SmoothDepth:
        return self


@contextmanager
def _smoothing() -> Iterator[None]:
    fit: Any = stream_loop.fit_first_frame

    def smoothed(*args: Any) -> Any:
        smooth: Any = _SmoothDepth((_Smooth(),) * len(args[1]))
        return fit(*args[:-1], smooth)

    with patch.object(stream_loop, "fit_first_frame", smoothed):
        yield


_PATCHES = {
    "penalties": lambda: _penalised(size_and_opacity),
    "needles": lambda: _penalised(needles),
    "exploration": _exploring,
    "smooth depth": _smoothing,
}


def gains(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the gain of each prior over none in held-out PSNR, dB, mean over the fits of each case."""
    found: dict[str, dict[str, float]] = {}
    mean = {
        (row["case"], row["prior"]): np.mean(
            [r["held_out"] for r in rows if (r["case"], r["prior"]) == (row["case"], row["prior"])]
        )
        for row in rows
    }
    for (case, prior), held_out in mean.items():
        without = mean.get((case, "none"), held_out)
        found.setdefault(case, {})[prior] = round(float(held_out if prior == "none" else held_out - without), 2)
    return found


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    about, cells = {}, {}
    for case, capture, train in options.cases():
        given = Source.of(capture), train, (capture.points, capture.point_colors)
        for prior, seed in product(options.priors, options.fit_seeds):
            name = f"{case}; {prior}; {seed}"
            cells[name] = *given, configured(options, prior, seed), prior
            about[name] = {"case": case, "prior": prior, "seed": seed}
    rows = [{**about[name], **row} for name, row in options.run(measure, cells).items()]
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "gains": gains(rows), "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
