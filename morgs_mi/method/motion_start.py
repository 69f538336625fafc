"""The start of the motion, and the images that it is found from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.core.types import Arrays
from morgs_mi.method.boxes import boxes_around
from morgs_mi.method.cohesion import NeighbourIndex
from morgs_mi.method.flow import ViewFlow
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.sweep import MAPS, KeyImages
from morgs_mi.render.active_view import narrowed

SOFT_LOGIT = 0.3
"""Logit of the confidence of a Gaussian that moves by a proposal or the search: 0.57, as some
accept a wrong motion by chance.
"""


@dataclass(frozen=True, eq=False)
class MotionStart:
    """Start of the motion, of the confidence, of the colour and of the rotation of N Gaussians."""

    #: D [N, 3] since the previous frame, world units; 0 for a Gaussian that does not move.
    displacement: np.ndarray
    logit_confidence: np.ndarray  #: Logit of the confidence that it moves [N].
    #: Change of the constant SH coefficients [N, 3]; None: none.
    color_change: np.ndarray | None = None
    rotation: np.ndarray | None = None  #: Change of the quaternions [N, 4]; None: none.

    @classmethod
    def without_motion(cls, gaussians: Gaussians) -> MotionStart:
        """Return the start of N Gaussians that stay in place, with their confidence; its logit is 0
        without one.
        """
        logit = gaussians.logit_confidence
        confidence = np.zeros(len(gaussians)) if logit is None else logit
        return cls(np.zeros((len(gaussians), 3), np.float32), np.array(confidence, np.float32))


@dataclass
class _SumsAt:
    """The sums of a sweep over displaced Gaussians."""

    displacement: np.ndarray | None = None  # [N, 3]; None: not computed yet
    sums: Arrays = field(default_factory=dict)  # by map


@dataclass(frozen=True, eq=False)
class MotionProblem:
    """N Gaussians of the previous frame, and images of this one that show their motion."""

    #: N Gaussians of the previous frame, detached; `motion` is their displacement into that frame.
    gaussians: Gaussians
    views: Mapping[int, ObservedView]  #: Active views with their images, by view index.
    rng: np.random.Generator  #: Draws the neighbours that proposals come from.
    _last: _SumsAt = field(default_factory=_SumsAt)

    @property
    def flows(self) -> list[ViewFlow]:
        """The views that have optical flow."""
        return [ViewFlow(view, view.flow) for view in self.views.values() if view.flow is not None]

    @cached_property
    def neighbours(self) -> NeighbourIndex:
        """Neighbours of the Gaussians in the previous frame, one index for all stages."""
        return NeighbourIndex(np.asarray(self.gaussians.means))

    @cached_property
    def images(self) -> KeyImages:
        """The images of all views, at least one."""
        return KeyImages(self.views)

    def sums_at(self, displacement: np.ndarray) -> Arrays:
        """Return the sums of all maps of a sweep, with the Gaussians displaced by d [N, 3]; kept
        until d is another.
        """
        last = self._last
        if last.displacement is not displacement:
            last.sums = self.images.sums(displaced(self.gaussians, displacement), [*MAPS])
            last.displacement = displacement
        return last.sums

    def images_around(
        self, selection: np.ndarray, displacements: Sequence[np.ndarray]
    ) -> KeyImages | None:
        """Return the images in the blocks that some Gaussians reach, in place or displaced; None if
        there are none.

        Args:
            selection: which Gaussians, bool [N].
            displacements: of all Gaussians, [N, 3] each.
        """
        some = self.gaussians.select(np.flatnonzero(selection))
        places = [some, *(displaced(some, d[selection]) for d in displacements if d.any())]
        config = next(iter(self.views.values())).config
        cameras = [view.camera for view in self.views.values()]
        every = np.ones(len(some), bool)
        reached = [boxes_around(place, cameras, config, 1.0).union(every) for place in places]
        views = narrowed(self.views, np.any(reached, axis=0))
        return KeyImages(views) if views else None
