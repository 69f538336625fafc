"""An active view with what its renderings are compared with."""

from __future__ import annotations

from dataclasses import dataclass, field

from morgs_mi.core.types import Arrays
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView


@dataclass(frozen=True, eq=False)
class ObservedView(ActiveView):
    """An active view with its image and, of a key view, with its observations."""

    target: Target = field(kw_only=True)  #: The image.
    observed: Arrays = field(default_factory=dict)  #: Observations [H, W, ...] by name.

    @classmethod
    def of(cls, view: ActiveView, target: Target, observed: Arrays | None = None) -> ObservedView:
        """Return a view with an image, and with observations [H, W, ...] by name."""
        drawn = (view.camera, view.config, view.region, view.static_splats)
        return cls(*drawn, target=target, observed=observed or {})
