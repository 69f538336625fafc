"""The plan of the first frame: as many Gaussians and steps as its images ask for and its time
allows.

The images ask for a number of Gaussians (see `detail`), and these for a number of steps
(`FitConfig.planned_steps`). Where that would take longer than `FitConfig.first_frame_seconds`, the
most Gaussians are chosen whose own number of steps fits the time. An eighth of those that the
images ask for is the least, because pixels take time as well: from there on, the steps are reduced.
Numbers that are given stay as they are; `check_capacity` compares them with the free memory.

The time of a step is modelled as

    a number of Gaussians + b number of pixels

with the factors of a reference machine, two cores of a server. The same command therefore gives the
same plan on every machine, and on a busy one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import mean_views
from morgs_mi.core.view import View
from morgs_mi.fit.detail import count_details
from morgs_mi.fit.first_frame import LAST_ROUND
from morgs_mi.fit.fit_config import MOST_GAUSSIANS, FitConfig
from morgs_mi.fit.view import half_sized
from morgs_mi.platform.memory import check_memory

PER_DETAIL = 1.5
"""Gaussians per detail that the views do not share."""
LEAST_GAUSSIANS = 4_000
"""Least number of Gaussians of a first frame whose number is not given."""
# Seconds of a first frame without a limit, on the reference machine.
_SECONDS = 120.0
# Seconds of a step per Gaussian, and per pixel of its view.
_GAUSSIAN_SECONDS = 2.2e-7
_PIXEL_SECONDS = 0.5e-7
# Least number of steps that a time leaves.
_LEAST_STEPS = 100
# The Gaussians that the images ask for, relative to the least that a time leaves.
_LEAST_SHARE = 8
# Arrays of each parameter: value, gradient and Adam's two moments.
_ARRAYS = 4
# Floats of a projected Gaussian.
_PROJECTED = 40
# Bytes of a float.
_FLOAT = 4
# Bytes of a pixel of a view: its image as bytes and as floats, and its reference.
_PIXEL = 30
# Gaussians for each pixel: far more than images determine, and such a fit would take days.
_MOST = 16
# Bytes of a step in the order of the views.
_STEP = 16
# Mean number of Gaussians while it grows from a half to all, relative to all.
_GROWING = 0.75


def plan_first_frame(
    views: Sequence[View], points: np.ndarray, config: FitConfig
) -> tuple[FitConfig, float | None]:
    """Return the settings of a first frame with both numbers, and its time on the reference
    machine in seconds, None if both were given.

    Args:
        views: V views, at least one.
        points: [P, 3] of the scene, world units, or none.
        config: settings of the fit.
    """
    if None not in (config.num_gaussians, config.first_frame_steps):
        return config, None
    plan = config
    limit = config.first_frame_seconds or _SECONDS
    pixels = _mean_pixels(views)
    half_pixels = _mean_pixels(half_sized(views))

    def seconds(plan: FitConfig) -> float:
        late_seconds = _step_seconds(plan.planned_gaussians, pixels)
        if not plan.density.rounds:
            return plan.planned_steps * late_seconds
        # A round of density control is a step in every view, at half the size.
        early_seconds = _step_seconds(_GROWING * plan.planned_gaussians, half_pixels)
        mean = LAST_ROUND * early_seconds + (1 - LAST_ROUND) * late_seconds
        return plan.planned_steps * mean + plan.density.rounds * len(views) * early_seconds

    if config.num_gaussians is None:
        # The most Gaussians that fit into the time, of those that the images ask for.
        details = sum(count_details(view.image, view.mask) for view in views)
        count = PER_DETAIL * details / mean_views([view.camera for view in views], points)
        most = int(np.clip(round(count), LEAST_GAUSSIANS, MOST_GAUSSIANS))
        least = min(max(LEAST_GAUSSIANS, most // _LEAST_SHARE), most)
        too_many = bisect_left(
            range(least + 1, most + 1),
            True,
            key=lambda n: seconds(replace(plan, num_gaussians=n)) > limit,
        )
        plan = replace(plan, num_gaussians=least + too_many)
    if config.first_frame_steps is None:
        affordable = int(plan.planned_steps * limit / seconds(plan))
        steps = max(_LEAST_STEPS, min(plan.planned_steps, affordable))
        plan = replace(plan, first_frame_steps=steps)
    return plan, seconds(plan)


def _mean_pixels(views: Sequence[View]) -> float:
    """Return the mean number of pixels of a view."""
    return float(np.mean([view.camera.width * view.camera.height for view in views]))


def _step_seconds(count: float, pixels: float) -> float:
    """Return the time of a step with `count` Gaussians."""
    return _GAUSSIAN_SECONDS * count + _PIXEL_SECONDS * pixels


def check_capacity(place: str, cameras: Sequence[Camera], config: FitConfig) -> None:
    """Raise an error unless there is memory for the numbers of Gaussians and of steps that a config
    gives.

    Args:
        place: where the error's sentence begins.
        cameras: the views.
        config: settings.

    Raises:
        ValueError: there is not, or there are too many Gaussians for the pixels.
    """
    rest = 3 * ((config.sh_degree + 1) ** 2 - 1)
    floats = sum(rest if attribute.width < 0 else attribute.width for attribute in ATTRIBUTES)
    gaussian_bytes = _FLOAT * (_ARRAYS * floats + _PROJECTED)
    sizes = {"num_gaussians": gaussian_bytes, "first_frame_steps": _STEP}
    for name, size in sizes.items():
        count = getattr(config, name) or 0
        check_memory(place, size * count, f"`{name}={count}`", "set a smaller number")
    pixels = sum(camera.width * camera.height for camera in cameras)
    if (config.num_gaussians or 0) > _MOST * pixels:
        raise ValueError(
            f"{place}: `num_gaussians` must be at most {_MOST * pixels}, {_MOST} for each pixel of "
            f"the views, got {config.num_gaussians}; set a smaller number."
        )
    check_memory(
        place,
        _PIXEL * pixels,
        f"{len(cameras)} views with {pixels} pixels",
        "fit smaller images (`downscale`), or fewer cameras",
    )
