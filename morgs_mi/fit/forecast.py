"""Forecast of views between the cameras, from the angles between neighbouring cameras and their
overlap alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import angles_between, scene_planes, seen_points

MANY_VIEWS = 6
"""Number of cameras from which they are not few."""
# Least `Forecast.reach` of cameras that are far apart, degrees.
_FAR = 24.0
# Largest `Forecast.reach` of good and of fair views between the cameras, degrees
# (`docs/experiments/first-frame.md`).
_GOOD = 9.5
_FAIR = 18.0
# Angle that stands for a point that no other camera sees, degrees.
_UNSEEN = 90.0


@dataclass(frozen=True)
class Forecast:
    """Expected quality of views between the cameras of a rig."""

    cameras: int  #: Number of cameras.
    spacing: float  #: Mean angle from a camera to its nearest one, seen from the scene, degrees.
    overlap: float  #: Mean share of a camera's image that its nearest one sees as well.
    #: Mean angle from a camera to the nearest one that sees the same point, degrees, 90 where there
    #: is none.
    reach: float

    @property
    def quality(self) -> str:
        """Quality to expect of views between the cameras: good, fair or poor."""
        return "good" if self.reach <= _GOOD else "fair" if self.reach <= _FAIR else "poor"

    @property
    def sentence(self) -> str:
        """The quality, its reasons, and what would make such views good."""
        reasons = (
            f"{self.cameras} cameras, {self.spacing:.0f} degrees apart, neighbours share "
            f"{100 * self.overlap:.0f} % of what they see"
        )
        sentence = f"Views between the cameras will be {self.quality}: {reasons}."
        if self.quality == "good":
            return sentence
        if self.spacing <= _GOOD:
            return f"{sentence} They would be good if neighbours shared more."
        return (
            f"{sentence} Cameras at most {int(_GOOD)} degrees apart would make them good: "
            f"{self._more} more on an arc."
        )

    @property
    def _more(self) -> int:
        """Number of further cameras that would make views good."""
        return ceil((self.cameras - 1) * (self.spacing / _GOOD - 1))


def are_far_apart(cameras: Sequence[Camera], points: np.ndarray) -> bool:
    """Return whether cameras are few and far apart; `points` as for `forecast`."""
    return 1 < len(cameras) < MANY_VIEWS and forecast(cameras, points).reach >= _FAR


def forecast(cameras: Sequence[Camera], points: np.ndarray) -> Forecast:
    """Return the forecast for a rig.

    Args:
        cameras: the training cameras, at least two.
        points: [P, 3] of the scene, world units; without any, `focus_point` of the cameras replaces
            them.
    """
    measures = []
    for view, plane in enumerate(scene_planes(cameras, points)):
        others = [*cameras[:view], *cameras[view + 1 :]]
        angles = plane.angles_to(others)
        visible = np.array([seen_points(other, plane.points)[0] for other in others])
        to_each = np.array([angles_between(plane.points, plane.camera, other) for other in others])
        nearest = np.where(visible, to_each, _UNSEEN).min(axis=0)
        measures.append((angles.min(), visible[angles.argmin()].mean(), nearest.mean()))
    spacing, overlap, reach = np.mean(measures, axis=0)
    return Forecast(len(cameras), float(spacing), float(overlap), float(reach))
