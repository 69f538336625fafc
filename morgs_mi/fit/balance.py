"""Balance of the cameras: their exposures in the first frame, from renderings of Gaussians that they share.

Rounds of a short fit of Gaussians and of the closed form of `method.exposure`, view by view, take turns. The Gaussians
have no view-dependent colours, which would hide wrong exposures. A fit from the same start to the recorded images is
compared in withheld pixels, blocks of every view that no fit has seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.progress import Progress
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.view import LEAST_GAIN, View, mean_psnr, rendered, withheld_blocks
from morgs_mi.method.exposure import Exposure, centred, fit_exposure

__all__ = ["Balance", "balance_cameras", "balance_config"]

# Fits that are compared: to the images as recorded and to the balanced ones.
_COMPARED = 2
# Difference of tones, of 1, from which `auto` considers to take the exposures: about a grey level.
_LEAST_DIFFERENCE = 0.005


@dataclass(frozen=True)
class Balance:
    """Result of balancing cameras.

    Attributes:
        exposures: estimated exposure of each camera, used or not.
        taken: whether they are used.
        recorded_psnr: of withheld pixels in a fit to the images as recorded, dB; NaN where they were not compared.
        balanced_psnr: of the same pixels in a fit to the balanced images, dB; NaN where they were not compared.
    """

    exposures: tuple[Exposure, ...]
    taken: bool
    recorded_psnr: float = float("nan")
    balanced_psnr: float = float("nan")

    @property
    def sentence(self) -> str:
        """Sentence on the change of the cameras and its reason."""
        change = f"exposures differ by up to {100 * max(exposure.change for exposure in self.exposures):.1f} % of white"
        scores = f"withheld pixels have {self.balanced_psnr:.2f} dB instead of {self.recorded_psnr:.2f} dB"
        if np.isnan(self.recorded_psnr):
            return f"The cameras {'were balanced' if self.taken else 'stay as recorded'}: {change}."
        if self.taken:
            return f"The cameras were balanced: {change}, and {scores}."
        return f"The cameras stay as recorded: balanced ones are no clear gain, {scores}."


def balance_config(config: FitConfig) -> FitConfig:
    """Return the settings of the short fits, without view-dependent colours and density control."""
    how = config.short_fits
    return replace(
        config,
        sh_degree=0,
        num_gaussians=how.gaussians,
        first_frame_steps=how.steps,
        dropping=0.0,
        density=replace(config.density, rounds=0),
    )


def balance_cameras(
    problem: FirstFrameProblem, config: FitConfig, seed: int, progress: Progress | None = None
) -> Balance:
    """Return the exposures with which the cameras agree, and whether withheld pixels show that they are better.

    Args:
        problem: the data of the first frame, with a start as for `balance_config`.
        config: of the fit; `exposure` "on" takes the exposures in any case.
        seed: of all random choices.
        progress: of the fits, in one stage.
    """
    how, short = config.short_fits, balance_config(config)
    progress, render, done = (progress or Progress()).of("Balancing cameras"), problem.render, 0
    kept, unseen = withheld_blocks(problem.views, how.width, rng_of(seed, Stream.WITHHELD_BLOCKS))
    as_recorded = {v: Exposure() for v in range(len(kept))}

    def fit(start: Gaussians, exposures: Mapping[int, Exposure], steps: int) -> Gaussians:
        nonlocal done
        corrected = [view._replace(image=exposures[v].corrected(view.image)) for v, view in enumerate(kept)]
        posed = replace(problem, start=start, views=tuple(corrected))
        fitted = fit_first_frame(posed, replace(short, first_frame_steps=steps), rng_of(seed, Stream.BALANCE))
        done += 1
        progress(done, how.rounds + _COMPARED)
        return fitted.gaussians

    exposures, gaussians = as_recorded, problem.start
    for k in range(how.rounds):
        gaussians = fit(gaussians, exposures, how.steps // 2 if k else how.steps)
        exposures = centred(
            {
                v: fit_exposure(rendered(gaussians, camera, render), image / 255, mask)
                for v, (camera, image, mask) in enumerate(kept)
            }
        )
    differ = max(exposure.change for exposure in exposures.values()) >= _LEAST_DIFFERENCE
    if config.exposure == "on" or not differ:
        return Balance(tuple(exposures.values()), config.exposure == "on")
    scores = []
    for candidate in (as_recorded, exposures):
        fitted = fit(problem.start, candidate, how.steps)
        compared = [
            View(camera, candidate[v].corrected(image), mask)
            for v, (camera, image, mask) in enumerate(unseen)
            if mask is not None and mask.any()
        ]
        scores.append(mean_psnr(fitted, compared, render))
    taken = scores[1] >= scores[0] + LEAST_GAIN
    return Balance(tuple(exposures.values()), taken, scores[0], scores[1])
