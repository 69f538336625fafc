"""Estimate of views between few cameras, of which none can be withheld: how far two fits differ there.

Two short fits with other random numbers start from other halves of the initial Gaussians. Where the images determine
the scene they agree; where they do not, each fills the gap in its own way. Of two independent fits with the same mean,
the mean square difference is twice the variance. So the mean square error of a view between the cameras is estimated by
half that difference and the error of the first frame in its training views (see `docs/experiments/first-frame.md`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import (
    decibels,
    reduced,
    rendered,
    shifted,
    squared_errors,
    trial_steps,
    verdict,
)
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.forecast import angles_to, scene_depths
from morgs_mi.fit.view import View
from morgs_mi.render.config import RenderConfig

__all__ = ["NUM_FITS", "Agreement", "compare_fits", "views_between"]

NUM_FITS = 2
"""Number of fits that are compared."""


@dataclass(frozen=True)
class Agreement:
    """Result of comparing two fits.

    Attributes:
        cameras: number of cameras.
        spacing: mean angle from a camera to its nearest one, as seen from what they look at, degrees.
        differences: PSNR of one fit against the other in each view between neighbouring cameras, dB.
        training_psnr: mean PSNR in the training views, of the two fits or of a longer one, dB.
    """

    cameras: int
    spacing: float
    differences: tuple[float, ...]
    training_psnr: float

    @property
    def expected_psnr(self) -> float:
        """Estimate of the mean PSNR of views between neighbouring cameras, dB."""
        variance, error = 10 ** (-np.array(self.differences) / 10) / 2, 10 ** (-self.training_psnr / 10)
        return float(decibels(variance + error).mean())

    @property
    def sentence(self) -> str:
        """What to expect of views between the cameras."""
        loss = self.training_psnr - self.expected_psnr
        estimate = f"about {self.expected_psnr:.0f} dB, estimated from two fits that differ there"
        return verdict(self.expected_psnr, loss, estimate, self.spacing)


def compare_fits(
    start: Gaussians,
    views: Sequence[View],
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    seed: int,
    on_step: Callable[[int], None] | None = None,
) -> Agreement:
    """Return how far two short fits agree between the cameras.

    Args:
        start: at least two Gaussians that the fits start from.
        views: the V training views, at least two.
        extent: of the scene in world units.
        config: settings of the fit.
        render: cut-offs.
        seed: of both fits.
        on_step: called with the number of steps done, in both fits.
    """
    steps, width = trial_steps(config), config.cross_validation.width
    views = [reduced(*view, width) for view in views]
    small, targets = [view.camera for view in views], [view.target for view in views]
    angles, between = views_between(small, np.asarray(start.means))
    errors, shown = [], []
    for k, rows in enumerate(np.array_split(rng_of(seed, Stream.TRIALS, NUM_FITS).permutation(len(start)), NUM_FITS)):
        given = start.select(np.sort(rows)), small, targets, extent, replace(config, first_frame_steps=steps), render
        tick = None if on_step is None else shifted(on_step, k * steps)
        fitted = fit_first_frame(*given, rng_of(seed, Stream.TRIALS, k), tick).gaussians
        errors.append(squared_errors(fitted, views, render))
        shown.append(np.stack([rendered(fitted, camera, render) for camera in between]))
    differences = decibels(np.array([np.mean((a - b) ** 2) for a, b in zip(*shown, strict=True)]))
    training = float(decibels(np.concatenate(errors)).mean())
    return Agreement(len(views), float(angles.mean()), tuple(differences.tolist()), training)


def views_between(cameras: Sequence[Camera], points: np.ndarray) -> tuple[np.ndarray, list[Camera]]:
    """Return the angle from each camera to its nearest one [V], degrees, and the views halfway between them.

    Args:
        cameras: V views, at least two.
        points: [P, 3] of the scene, world units.
    """
    to_all = np.array([angles_to(*view, cameras) for view in zip(cameras, scene_depths(cameras, points), strict=True)])
    np.fill_diagonal(to_all, np.inf)
    nearest = to_all.argmin(axis=1)
    pairs = sorted({(min(i, int(j)), max(i, int(j))) for i, j in enumerate(nearest)})
    return to_all.min(axis=1), [_halfway(cameras[i], cameras[j]) for i, j in pairs]


def _halfway(a: Camera, b: Camera) -> Camera:
    """Return the view of `a` from the middle between two cameras, turned halfway to `b`."""
    left, _, right = np.linalg.svd(a.viewmat[:3, :3] + b.viewmat[:3, :3])
    viewmat = np.eye(4)
    viewmat[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    viewmat[:3, 3] = -viewmat[:3, :3] @ (a.position + b.position) / 2
    return replace(a, viewmat=viewmat)
