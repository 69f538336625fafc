"""Balance of the cameras: their exposures in the first frame, from what Gaussians that they share look like.

Rounds of a short fit of Gaussians and of the closed form of `method.exposure`, view by view, take turns. The Gaussians
have no view-dependent colours, which would hide wrong exposures. A fit from the same start with the cameras as recorded
is compared by pixels that no fit has seen: blocks that are withheld from every view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import mean_psnr, rendered, shifted, withheld_blocks
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.view import View
from morgs_mi.losses.ssim import Target
from morgs_mi.method.exposure import Exposure, centred, fit_exposure
from morgs_mi.render.config import RenderConfig

__all__ = ["Balance", "balance_cameras", "balance_config"]


@dataclass(frozen=True)
class Balance:
    """Result of balancing cameras.

    Attributes:
        exposures: of each camera; those found, taken or not.
        taken: whether they are used.
        recorded_psnr: of withheld pixels in a fit to the images as recorded, dB; NaN where they were not compared.
        balanced_psnr: of the same pixels in a fit to the balanced images, dB; likewise.
        steps: optimisation steps.
    """

    exposures: tuple[Exposure, ...]
    taken: bool
    recorded_psnr: float
    balanced_psnr: float
    steps: int

    @property
    def sentence(self) -> str:
        """What was changed, and why."""
        change = f"exposures differ by up to {100 * max(exposure.change for exposure in self.exposures):.1f} % of white"
        scores = f"withheld pixels have {self.balanced_psnr:.2f} dB instead of {self.recorded_psnr:.2f} dB"
        if np.isnan(self.recorded_psnr):
            return f"The cameras {'were balanced' if self.taken else 'stay as recorded'}: {change}."
        if self.taken:
            return f"The cameras were balanced: {change}, and {scores}."
        return f"The cameras stay as recorded: balanced ones are no clear gain, {scores}."


def balance_config(config: FitConfig) -> FitConfig:
    """Return the settings of the short fits, without view-dependent colours and density control."""
    how = config.exposures
    return replace(
        config,
        sh_degree=0,
        num_gaussians=how.gaussians,
        first_frame_steps=how.steps,
        dropping=0.0,
        density=replace(config.density, rounds=0),
    )


def balance_cameras(
    start: Gaussians,
    views: Sequence[View],
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    seed: int,
    on_step: Callable[[int], None] | None = None,
) -> Balance:
    """Return the exposures with which the cameras agree, and whether withheld pixels show that they are better.

    Args:
        start: Gaussians that a fit starts from, as for `balance_config`.
        views: V views.
        extent: of the scene in world units.
        config: of the fit; `exposure` "on" takes the exposures in any case.
        render: cut-offs.
        seed: of all random choices.
        on_step: called with the number of steps done, in all fits.
    """
    how, short = config.exposures, balance_config(config)
    kept, unseen = withheld_blocks(views, how.width, seed)
    exposures, gaussians, done = {v: Exposure() for v in range(len(views))}, start, 0

    def fit(gaussians: Gaussians, exposures: Mapping[int, Exposure], steps: int) -> Gaussians:
        nonlocal done
        targets = [Target(exposures[v].corrected(image), mask) for v, (_, image, mask) in enumerate(kept)]
        tick = None if on_step is None else shifted(on_step, done)
        settings, rng = replace(short, first_frame_steps=steps), rng_of(seed, Stream.BALANCE)
        reduced = [view.camera for view in kept]
        done += steps
        return fit_first_frame(gaussians, reduced, targets, extent, settings, render, rng, tick).gaussians

    for k in range(how.rounds):
        gaussians = fit(gaussians, exposures, how.steps // 2 if k else how.steps)
        exposures = centred(
            {
                v: fit_exposure(rendered(gaussians, camera, render), image / 255, mask, weights=how.priors)
                for v, (camera, image, mask) in enumerate(kept)
            }
        )
    differ = max(exposure.change for exposure in exposures.values()) >= how.least_difference
    if config.exposure == "on" or not differ:
        return Balance(tuple(exposures.values()), config.exposure == "on", float("nan"), float("nan"), done)
    scores = []
    for candidate in ({v: Exposure() for v in exposures}, exposures):
        fitted = fit(start, candidate, how.steps)
        judged = [
            View(camera, candidate[v].corrected(image), mask)
            for v, (camera, image, mask) in enumerate(unseen)
            if mask is not None and mask.any()
        ]
        scores.append(mean_psnr(fitted, judged, render))
    taken = scores[1] >= scores[0] + how.least_gain
    return Balance(tuple(exposures.values()), taken, scores[0], scores[1], done)
