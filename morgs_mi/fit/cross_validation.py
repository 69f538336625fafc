"""Cross-validation of the first frame: how well views between the cameras will look, and which prior helps them.

Some training views are withheld, and a short fit to the others is judged by the PSNR of the withheld ones. It chooses
the probability of dropping (see `dropping`): where images are noisy or few, dropping helps; where they are many and
clean, it only costs. Candidates are tried in rising order until one is no better than the last. Of few views none can
be spared: there the noise of the images decides.

The error that a withheld view has more than the others grows with its angle to them. Views halfway between neighbouring
cameras are nearer, and have as much less of it (see `docs/experiments/first-frame.md`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.forecast import POOR_LOSS, angles_to, forecast, scene_depths
from morgs_mi.fit.view import View
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = [
    "CrossValidation",
    "Trial",
    "cross_validate",
    "decibels",
    "mean_psnr",
    "reduced",
    "rendered",
    "shifted",
    "squared_errors",
    "trial_steps",
    "verdict",
    "withheld_blocks",
    "withheld_views",
]

_MIN_SIDE = 32  # px
# Withheld blocks: side in px, and one of how many.
_BLOCK, _SHARE = 12, 8
POOR_PSNR = 22.0
"""PSNR in dB below which views between the cameras look poor."""


@dataclass(frozen=True)
class Trial:
    """One fit.

    Attributes:
        dropping: probability of dropping.
        withheld_psnr: mean PSNR of the withheld views, dB.
        training_psnr: mean PSNR of the others, dB.
    """

    dropping: float
    withheld_psnr: float
    training_psnr: float


@dataclass(frozen=True)
class CrossValidation:
    """What cross-validation found.

    Attributes:
        withheld: names of the withheld views.
        spacing: mean angle from a camera to its nearest one, as seen from what they look at, in degrees.
        withheld_angle: mean angle from a withheld view to the nearest of the others, in degrees.
        trials: the fits, by rising probability of dropping.
        training_psnr: mean PSNR of the first frame itself in the training views, dB; None: not fitted yet.
    """

    withheld: tuple[str, ...]
    spacing: float
    withheld_angle: float
    trials: tuple[Trial, ...]
    training_psnr: float | None = None

    @property
    def best(self) -> Trial:
        """The fit with the best withheld views."""
        return max(self.trials, key=lambda trial: trial.withheld_psnr)

    @property
    def expected_psnr(self) -> float:
        """Estimate of the mean PSNR of views halfway between neighbouring cameras, dB.

        What the withheld views have more error than the others in the trial, in proportion to the angles, and the error
        of the first frame in its training views, which has more steps than the trial.
        """
        best = self.best
        training_psnr = best.training_psnr if self.training_psnr is None else self.training_psnr
        withheld, trained, own = (
            10 ** (-psnr / 10) for psnr in (best.withheld_psnr, best.training_psnr, training_psnr)
        )
        nearer = min(0.5 * self.spacing, self.withheld_angle) / max(self.withheld_angle, 1e-6)
        return float(decibels(np.array(nearer * max(withheld - trained, 0.0) + own)))

    @property
    def sentence(self) -> str:
        """What to expect of views between the cameras."""
        gap = (self.training_psnr or self.best.training_psnr) - self.expected_psnr
        estimate = f"about {self.expected_psnr:.0f} dB, estimated from {', '.join(self.withheld)} in a trial without it"
        if len(self.withheld) > 1:
            estimate = estimate.removesuffix("it") + "them"
        return verdict(self.expected_psnr, gap, estimate, self.spacing)


def cross_validate(
    start: Gaussians,
    views: Sequence[View],
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    seed: int,
    on_step: Callable[[int], None] | None = None,
) -> CrossValidation:
    """Return what cross-validation of the first frame finds.

    Args:
        start: Gaussians that each fit starts from.
        views: the V training views, at least two.
        extent: of the scene in world units.
        config: settings of the fit.
        render: cut-offs.
        seed: of every fit.
        on_step: called with the number of steps done, in all fits.
    """
    how = config.cross_validation
    cameras = [camera for camera, *_ in views]
    withheld, steps = withheld_views(cameras, how.share), trial_steps(config)
    small = [reduced(*view, how.width) for view in views]
    kept = [index for index in range(len(small)) if index not in withheld]
    trained, judged = [small[index] for index in kept], [small[index] for index in withheld]
    rig, targets = [view.camera for view in trained], [view.target for view in trained]
    trials: list[Trial] = []
    for dropping in how.candidates:
        trial, rng = replace(config, dropping=dropping, first_frame_steps=steps), rng_of(seed, Stream.TRIALS)
        tick = None if on_step is None else shifted(on_step, len(trials) * steps)
        fitted = fit_first_frame(start, rig, targets, extent, trial, render, rng, tick).gaussians
        trials.append(Trial(dropping, mean_psnr(fitted, judged, render), mean_psnr(fitted, trained, render)))
        if len(trials) > 1 and trials[-1].withheld_psnr <= trials[-2].withheld_psnr:
            break
    names, points = tuple(cameras[v].name for v in withheld), np.asarray(start.means)
    depths, others = scene_depths(cameras, points), [cameras[v] for v in kept]
    angle = float(np.mean([angles_to(cameras[v], depths[v], others).min() for v in withheld]))
    return CrossValidation(names, forecast(cameras, points).spacing, angle, tuple(trials))


def verdict(expected_psnr: float, loss: float, estimate: str, spacing: float) -> str:
    """Return the sentence on views between the cameras.

    Args:
        expected_psnr: of these views, dB.
        loss: what they have less than the training views, dB.
        estimate: their PSNR and how it was estimated, in words.
        spacing: mean angle from a camera to its nearest one, degrees.
    """
    if expected_psnr >= POOR_PSNR and loss <= POOR_LOSS:
        return f"Views between the cameras will have {estimate}."
    return (
        f"Views between the cameras will be poor: {estimate}, {loss:.0f} dB below the other views; the cameras are "
        f"{spacing:.0f} degrees apart."
    )


def shifted(on_step: Callable[[int], None], done: int) -> Callable[[int, int], None]:
    """Return what a fit calls with (steps, steps in all), after `done` steps of other fits."""
    return lambda step, _: on_step(done + step)


def trial_steps(config: FitConfig) -> int:
    """Return the number of steps of one fit."""
    return max(1, round(config.cross_validation.steps * config.planned_steps))


def withheld_views(cameras: Sequence[Camera], share: int) -> tuple[int, ...]:
    """Return the indices of the withheld views: one of `share`, at least one, spread over the inner half of the rig.

    Views at its ends are not between others.
    """
    count, positions = max(1, len(cameras) // share), np.array([camera.position for camera in cameras])
    away = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    inner = np.argsort(away, kind="stable")[: max(count, len(cameras) // 2)]
    chosen = [int(inner[0])]
    while len(chosen) < count:
        distance = np.linalg.norm(positions[inner][:, None] - positions[chosen], axis=-1).min(axis=1)
        chosen.append(int(inner[np.argmax(distance)]))
    return tuple(sorted(chosen))


def reduced(camera: Camera, image: np.ndarray, mask: np.ndarray | None, width: int) -> View:
    """Return a view reduced by the largest whole factor that leaves a width.

    A pixel is valid if all that it covers is.
    """
    factor = camera.width // width
    if factor < 2 or camera.height // factor < _MIN_SIDE:
        return View(camera, image, mask)
    size = (camera.width // factor, camera.height // factor)
    smaller = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    valid = None if mask is None else cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    return View(camera.resized(*size), smaller, valid)


def withheld_blocks(views: Sequence[View], width: int, seed: int) -> tuple[list[View], list[View]]:
    """Return the reduced views without withheld blocks of pixels, and with these alone, which may be none in a view.

    Args:
        views: V views.
        width: least width of the reduced images, px.
        seed: of the choice of the blocks.
    """
    rng, kept, unseen = rng_of(seed, Stream.WITHHELD_BLOCKS), [], []
    for camera, image, mask in (reduced(*view, width) for view in views):
        rows, columns = (np.arange(size) // _BLOCK for size in image.shape[:2])
        withheld = (rng.random((rows[-1] + 1, columns[-1] + 1)) < 1 / _SHARE)[rows][:, columns]
        valid = np.ones_like(withheld) if mask is None else mask
        kept.append(View(camera, image, valid & ~withheld))
        unseen.append(View(camera, image, valid & withheld))
    return kept, unseen


def squared_errors(gaussians: Gaussians, views: Sequence[View], render: RenderConfig) -> np.ndarray:
    """Return the mean square error of each view [V], of its valid pixels."""
    errors = []
    for camera, image, mask in views:
        squares = ((rendered(gaussians, camera, render) - image / 255.0) ** 2).mean(axis=-1)
        errors.append(squares[slice(None) if mask is None else mask].mean())
    return np.array(errors)


def rendered(gaussians: Gaussians, camera: Camera, render: RenderConfig) -> np.ndarray:
    """Return the image of a view [H, W, 3] in [0, 1]."""
    return np.clip(np.asarray(rasterize(gaussians, camera, ("color",), config=render).color), 0, 1)


def decibels(squares: np.ndarray) -> np.ndarray:
    """Return the PSNR of mean square errors, dB."""
    return -10 * np.log10(np.maximum(squares, 1e-10))


def mean_psnr(gaussians: Gaussians, views: Sequence[View], render: RenderConfig) -> float:
    """Return the mean PSNR of some views in dB, of their valid pixels."""
    return float(decibels(squared_errors(gaussians, views, render)).mean())
