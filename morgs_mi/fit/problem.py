"""The problem of the first frame: the views of one timestamp, and the Gaussians that a fit to them
starts from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import scene_depths, scene_extent
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import Points, from_points, initial_points
from morgs_mi.fit.view import View
from morgs_mi.render.render_config import RenderConfig

# Least scene extent, relative to the median depth: of means that move by fractions of the extent.
_DEPTH = 1 / 6
# Opacity of the Gaussians at the start: most can become opaque or vanish within the steps of a
# first frame.
_OPACITY = 0.3


@dataclass(frozen=True, eq=False)
class FirstFrameProblem:
    """Data to which the first frame is fitted."""

    start: Gaussians  #: Initial Gaussians.
    views: tuple[View, ...]  #: V views of one timestamp.
    points: np.ndarray  #: [P, 3] of the scene, world units, or none.
    #: Of the scene in world units, at least a sixth of its depth: cameras close together see far.
    extent: float
    render: RenderConfig  #: Cut-offs.

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        points: Points,
        config: FitConfig,
        render: RenderConfig,
        rng: np.random.Generator,
    ) -> FirstFrameProblem:
        """Return the problem with Gaussians at the points, and at random points where the views
        show none.

        Args:
            views: V views, at least one.
            points: P points and their colours; P may be 0.
            config: number and SH degree of the Gaussians.
            render: cut-offs.
            rng: draws points.
        """
        start_points = initial_points(views, points, config.first_count, rng)
        start = from_points(*start_points, config.sh_degree, _OPACITY)
        cameras = [view.camera for view in views]
        extent = max(
            scene_extent(cameras), _DEPTH * float(np.median(scene_depths(cameras, start_points[0])))
        )
        return cls(start, tuple(views), points[0], extent, render)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the views."""
        return [view.camera for view in self.views]
