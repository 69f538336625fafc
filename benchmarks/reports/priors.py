"""Priors of the first frame: held-out views of captures of all kinds with each, and without.

    python -m benchmarks.reports.priors --captures PHOTOS... --json out.json

The synthetic cases are `morgs-mi synth random` with as many training views as the case says, spread over the rig, and
points from stereo. Of other captures, every fifth view is held out. Only dropping and the weight of D-SSIM are settings
of the package; the other priors are patched into the fit here:

    penalties     0.01 mean(opacity) + 0.01 mean(scale / extent), as 3DGS-MCMC has them
    needles       mean(log(longest axis / (3 middle axis))), where that is positive
    exploration   noise of the means of nearly transparent Gaussians in every step, as 3DGS-MCMC has it
    smooth depth  0.1 mean|second derivative of the inverse depth|, falling to 0 over the steps
    flat normals  0.1 mean|difference of the normals of neighbouring pixels|, falling to 0 over the steps
    noise-aware   Huber's loss beyond twice the noise in place of L1, and less D-SSIM, whose C2 grows by its variance
    exact depth   the depth prior, with the exact depth of synthetic captures in place of a network's
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
from benchmarks.reports.depth_prior import exact_depth
from benchmarks.reports.few_views import spread_views, with_points
from benchmarks.reports.fits import first_frame
from morgs_mi import stream_loop
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Jit, Tensor
from morgs_mi.fit import first_frame as first
from morgs_mi.fit.depth_prior import depth_prior
from morgs_mi.fit.noise import noise_of
from morgs_mi.fit.optimise import replace_parameter
from morgs_mi.losses.ssim import Target
from morgs_mi.render.rasterize import Image
from morgs_mi.synth.synthesize import synthesize

CASES = ((20, 16, 0.0), (21, 8, 0.0), (22, 4, 0.0), (23, 16, 0.02), (24, 8, 0.02), (25, 4, 0.02))
"""Seed of the scene, number of training views, and noise of the reduced images relative to white."""

Points = tuple[np.ndarray, np.ndarray]
_C2 = 0.03**2  # of SSIM


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
        "flat normals",
        "noise-aware",
        "exact depth",
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
    patched = _PATCHES[prior]() if prior in _PATCHES else ExitStack()
    if prior == "exact depth":
        patched = _known_depth(source.open(), train, points[0])
    with patched:
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
        noise_aware=False,
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
class _Flat:
    """Stands in for the inverse depth of a view, too: the normals of neighbouring pixels are drawn to each other."""

    camera: Camera

    def loss(self, image: Image) -> Tensor:
        height, width = image.depth.shape[:2]
        x, y = (a.ravel() for a in np.meshgrid(np.arange(width - 2), np.arange(height - 2)))
        (fx, _, cx), (_, fy, cy), _ = self.camera.K.tolist()

        def point(dx: int, dy: int) -> mi.Vector3f:
            column, row = (from_numpy(mi.UInt32, (a + d).astype(np.uint32)) for a, d in ((x, dx), (y, dy)))
            depth: Jit = dr.gather(mi.Float, image.depth.array, row * width + column)
            return depth * mi.Vector3f((column + (0.5 - cx)) / fx, (row + (0.5 - cy)) / fy, 1)

        def normal(dx: int, dy: int) -> mi.Vector3f:
            here = point(dx, dy)
            across, down = point(dx + 1, dy) - here, point(dx, dy + 1) - here
            # In units of the depth, so that the small number below makes flat what has no depth.
            found = dr.cross(across, down) * dr.rcp(dr.square(dr.detach(dr.maximum(here.z, 1e-6))))
            return found * dr.rsqrt(dr.squared_norm(found) + 1e-12)

        middle = normal(0, 0)
        return sum(dr.mean(dr.norm(normal(*offset) - middle + 1e-6)) for offset in ((1, 0), (0, 1)))


@dataclass(frozen=True)
class _Stand:
    """Stands in for a `DepthPrior`."""

    aligned: tuple[Any, ...]

    def realigned(self, *_: Any) -> _Stand:
        return self


@contextmanager
def _with_depth_term(prior: Callable[[Sequence[Camera]], Any]) -> Iterator[None]:
    """Fit with a depth prior that follows from the cameras."""
    fit: Any = stream_loop.fit_first_frame

    def fitted(*args: Any) -> Any:
        return fit(*args[:-1], prior(args[1]))

    with patch.object(stream_loop, "fit_first_frame", fitted):
        yield


def _known_depth(capture: Capture, train: Sequence[int], points: np.ndarray) -> Any:
    """Fit with the exact inverse depth of the training views, which a capture without truth refuses."""
    if capture.truth is None:
        raise ValueError(f"{capture.path}: expected the truth beside the capture, found none; leave `exact depth` out.")
    cameras = [capture.cameras[v] for v in train]
    depths = [exact_depth(capture, camera) for camera in cameras]
    inverse = [np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0) for depth in depths]
    return _with_depth_term(lambda _: depth_prior(inverse, cameras, points))


def huber(image: Tensor, target: Target, threshold: float) -> Tensor:
    """Return the mean of Huber's loss, the absolute error less half the threshold beyond it."""
    error = dr.abs(image.array - target.planes.image(target.pixels))
    return dr.mean(dr.select(error < threshold, error * error / (2 * threshold), error - threshold / 2))


@contextmanager
def _noise_aware() -> Iterator[None]:
    noise: dict[int, float] = {}
    recon_loss = first.recon_loss

    def aware(image: Tensor, target: Target, dssim_weight: float) -> Tensor:
        if id(target) not in noise:
            noise[id(target)] = noise_of((255 * target.image()).astype(np.uint8))
        sigma = noise[id(target)]
        weight = dssim_weight * _C2 / (_C2 + 2 * sigma**2)
        similar = recon_loss(image, target, 1.0)
        return (1 - weight) * huber(image, target, max(2 * sigma, 1e-4)) + weight * similar

    with patch.object(first, "recon_loss", aware):
        yield


_PATCHES = {
    "penalties": lambda: _penalised(size_and_opacity),
    "needles": lambda: _penalised(needles),
    "exploration": _exploring,
    "smooth depth": lambda: _with_depth_term(lambda cameras: _Stand((_Smooth(),) * len(cameras))),
    "flat normals": lambda: _with_depth_term(lambda cameras: _Stand(tuple(map(_Flat, cameras)))),
    "noise-aware": _noise_aware,
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
        known = [prior for prior in options.priors if capture.truth is not None or prior != "exact depth"]
        for prior, seed in product(known, options.fit_seeds):
            name = f"{case}; {prior}; {seed}"
            cells[name] = *given, configured(options, prior, seed), prior
            about[name] = {"case": case, "prior": prior, "seed": seed}
    rows = [{**about[name], **row} for name, row in options.run(measure, cells).items()]
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "gains": gains(rows), "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
