"""Correction of recorded images to the colours of the scene, which all views share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from morgs_mi.core.progress import Progress
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.balance import balance_cameras, balance_config
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.loop.observation import Images, Setup, views_of
from morgs_mi.method.exposure import Exposure


@dataclass(frozen=True)
class Correction:
    """Exposures of the first frame, relative to the scene; the identity by default."""

    exposures: tuple[Exposure, ...] = ()  #: Of each view; empty if they are not estimated.

    def corrected(self, images: Images) -> dict[int, np.ndarray]:
        """Return images, by view index, in the colours of the scene."""
        return {
            v: self.exposures[v].corrected(image) if self.exposures else image
            for v, image in images.items()
        }

    def followed_by(self, relative: Mapping[int, Exposure]) -> tuple[Exposure, ...]:
        """Return the exposures of a frame, with those relative to the view's first image by view
        index.
        """
        return tuple(
            relative.get(v, Exposure()).after(first) for v, first in enumerate(self.exposures)
        )


def estimate_correction(
    setup: Setup, images: Images, progress: Progress
) -> tuple[Correction, dict[str, Any]]:
    """Return the correction by the balance of the cameras, and its entry of the first frame's
    report.

    Args:
        setup: data that all frames share.
        images: of the first frame, by view index.
        progress: of the short fits.
    """
    if setup.config.fit.exposure == "off":
        return Correction(), {}
    if len(images) < 2:
        return _correction(setup, {}), {}
    config = setup.config
    rng = rng_of(config.seed, Stream.BALANCED_POINTS)
    views = views_of(setup, images)
    fit = balance_config(config.fit)
    problem = FirstFrameProblem.of(views, setup.cloud, fit, config.render, rng)
    balance = balance_cameras(problem, config.fit, config.seed, progress)
    exposures = dict(zip(images, balance.exposures, strict=True)) if balance.taken else {}
    scores = {"recorded_psnr": balance.recorded_psnr, "balanced_psnr": balance.balanced_psnr}
    entry = {"sentence": balance.sentence, "taken": balance.taken, **scores}
    return _correction(setup, exposures), {"exposure": entry}


def _correction(setup: Setup, exposures: Mapping[int, Exposure]) -> Correction:
    """Return the correction of all views by exposures by view index, the identity without one."""
    return Correction(tuple(exposures.get(v, Exposure()) for v in range(len(setup.cameras))))
