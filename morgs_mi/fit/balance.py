"""Balance of the cameras: their exposures in the first frame, from renderings of Gaussians that
they share.

Rounds of a short fit of Gaussians and of the closed form of `method.exposure`, view by view, take
turns. The Gaussians have no view-dependent colours, which would hide wrong exposures. Where the
cameras are alike, the first round shows it and is the last. Otherwise a fit from the same start to
the recorded images is compared in withheld pixels, blocks of every view that no fit has seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.view import View
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.view import LEAST_GAIN, mean_psnr, rendered, withheld_blocks
from morgs_mi.method.exposure import Exposure, centred, fit_exposure
from morgs_mi.platform.progress import Progress

# Fits that are compared: to the images as recorded and to the balanced ones.
_COMPARED = 2
# Difference of tones, of 1, below which `auto` takes cameras as alike. The first round measures up
# to 0.002 on path-traced cameras without differences, 0.003 and 0.009 on real ones, and 0.16 and
# more on rigs that `info` warns of.
LEAST_DIFFERENCE = 0.01
# Steps of the first frame per step of a short fit, at least: the balance must not cost more than
# it.
_LEAST_SHARE = 4


@dataclass(frozen=True)
class Balance:
    """Result of balancing cameras."""

    exposures: tuple[Exposure, ...]  #: Estimated exposure of each camera, used or not.
    taken: bool  #: Whether they are used.
    #: Of withheld pixels in a fit to the images as recorded, dB; NaN where they were not compared.
    recorded_psnr: float = float("nan")
    #: Of the same pixels in a fit to the balanced images, dB; NaN where they were not compared.
    balanced_psnr: float = float("nan")

    @property
    def sentence(self) -> str:
        """Sentence on the change of the cameras and its reason."""
        largest = max(exposure.change for exposure in self.exposures)
        change = f"exposures differ by up to {100 * largest:.1f} % of white"
        if np.isnan(self.recorded_psnr):
            return f"The cameras {'were balanced' if self.taken else 'stay as recorded'}: {change}."
        scores = (
            f"withheld pixels have {self.balanced_psnr:.2f} dB instead of {self.recorded_psnr:.2f} "
            "dB"
        )
        if self.taken:
            return f"The cameras were balanced: {change}, and {scores}."
        return f"The cameras stay as recorded: balanced ones are no clear gain, {scores}."


def short_fit_config(config: FitConfig) -> FitConfig:
    """Return the settings of the short fits, without view-dependent colours and density control."""
    how = config.short_fits
    return replace(
        config,
        sh_degree=0,
        num_gaussians=how.gaussians,
        first_frame_steps=max(1, min(how.steps, config.planned_steps // _LEAST_SHARE)),
        dropout=0.0,
        density=replace(config.density, rounds=0),
    )


def balance_cameras(
    problem: FirstFrameProblem,
    config: FitConfig,
    seed: int,
    progress: Progress,
    on_round: Callable[[Gaussians], None] | None = None,
) -> Balance:
    """Return the exposures with which the cameras agree, and whether withheld pixels show that they
    are better.

    Args:
        problem: the data of the first frame, with a start as for `short_fit_config`.
        config: of the fit; `exposure` "on" takes the exposures in any case.
        seed: of all random choices.
        progress: of the fits, in one stage.
        on_round: called with the Gaussians of each round.
    """
    report = progress.of("Balancing cameras")
    how = config.short_fits
    rng = rng_of(seed, Stream.WITHHELD_BLOCKS)
    visible, withheld = withheld_blocks(problem.views, how.width, rng)
    short_config = short_fit_config(config)
    steps = short_config.planned_steps
    count = 0
    report(0, how.rounds + _COMPARED)

    def fitted(start: Gaussians, exposures: Sequence[Exposure], steps: int) -> Gaussians:
        """Return Gaussians after some steps, from a start, in the colours of the scene."""
        nonlocal count
        fit_problem = replace(problem, start=start, views=tuple(_corrected(visible, exposures)))
        fit_config = replace(short_config, first_frame_steps=steps)
        part = report.part(count, how.rounds + _COMPARED)
        result = fit_first_frame(fit_problem, fit_config, rng_of(seed, Stream.BALANCE), part)
        count += 1
        return result.gaussians

    as_recorded = (Exposure(),) * len(problem.views)
    exposures = as_recorded
    gaussians = problem.start
    for k in range(how.rounds):
        gaussians = fitted(gaussians, exposures, -(-steps // 2) if k else steps)
        if on_round is not None:
            on_round(gaussians)
        # Relative to the Gaussians, without what most cameras have in common.
        exposures = centred(
            [
                fit_exposure(
                    rendered(gaussians, view.camera, problem.render),
                    unit_values(view.image),
                    view.mask,
                )
                for view in visible
            ]
        )
        largest = max(exposure.change for exposure in exposures)
        if config.exposure == "auto" and largest < LEAST_DIFFERENCE:
            return Balance(exposures, False)
    if config.exposure == "on":
        return Balance(exposures, True)
    scores = []
    for view_exposures in (as_recorded, exposures):
        gaussians = fitted(problem.start, view_exposures, steps)
        views = _corrected(withheld, view_exposures)
        scores.append(mean_psnr(gaussians, views, problem.render))
    recorded_psnr, balanced_psnr = scores
    is_gain = balanced_psnr >= recorded_psnr + LEAST_GAIN
    return Balance(exposures, is_gain, recorded_psnr, balanced_psnr)


def _corrected(views: Sequence[View], exposures: Sequence[Exposure]) -> list[View]:
    """Return views with images in the colours of the scene, by their exposures."""
    pairs = zip(views, exposures, strict=True)
    return [replace(view, image=exposure.corrected(view.image)) for view, exposure in pairs]
