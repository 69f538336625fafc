"""An active view with what its renderings are compared with."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mitsuba as mi

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.types import Arrays
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView


@dataclass(frozen=True, eq=False)
class ObservedView(ActiveView):
    """An active view with its image and, of a key view, with its observations."""

    target: Target = field(kw_only=True)  #: The image.
    observed: Arrays = field(default_factory=dict)  #: Observations [H, W, ...] by name.
    flow: FlowObservation | None = None  #: Optical flow of a key view; None of any other.

    @cached_property
    def observations(self) -> dict[str, Any]:
        """Target and observations by name; observations are tensors [H, W, ...], or [A, h, w, ...]
        of the A blocks of a region.
        """
        cropped = {name: self.crop(image) for name, image in self.observed.items()}
        tensors = {name: from_numpy(mi.TensorXf, image) for name, image in cropped.items()}
        return {"target": self.target, **tensors}

    @classmethod
    def of(
        cls,
        view: ActiveView,
        target: Target,
        observed: Arrays | None = None,
        flow: FlowObservation | None = None,
    ) -> ObservedView:
        """Return a view with an image, and a key view with its observations and flow."""
        drawn = (view.camera, view.config, view.region, view.static_splats)
        return cls(*drawn, target=target, observed=observed or {}, flow=flow)
