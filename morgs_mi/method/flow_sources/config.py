"""Settings of optical flow."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FlowConfig"]

# DIS needs patches of 8 pixels on its coarsest level.
_LEAST_SIDE = 16


@dataclass(frozen=True)
class FlowConfig:
    """Settings of OpenCV's methods and of the forward-backward check.

    Raises:
        ValueError: a number is out of range.
    """

    min_side: int = 16
    """Side of an image in pixels below which OpenCV's methods have too little to match: the flow is zero."""
    fine_width: int = 480
    """Width in pixels up to which `dis` goes to full resolution; in wider images it stops at half resolution."""
    consistency_relative: float = 0.01
    """Forward-backward check: tolerated squared mismatch as a share of the squared lengths of both flows."""
    consistency_absolute: float = 0.5
    """Forward-backward check: tolerated squared mismatch of the shortest flows, px^2."""

    def __post_init__(self) -> None:
        least = {"min_side": _LEAST_SIDE, "fine_width": 0}
        for name, bound in (least | {"consistency_relative": 0, "consistency_absolute": 0}).items():
            if not getattr(self, name) >= bound:
                raise ValueError(f"FlowConfig(): `{name}` must be at least {bound}, got {getattr(self, name)}.")
