"""Settings of optical flow."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge

from morgs_mi.core.config import config_class


@config_class
class FlowConfig:
    """Settings of OpenCV's methods and of the forward-backward check.

    Raises:
        ValueError: a number is out of range.
    """

    fine_width: Annotated[int, Ge(0)] = 480
    """Width in pixels up to which `dis` goes to full resolution; in wider images it stops at half
    resolution.
    """
    consistency_relative: Annotated[float, Ge(0)] = 0.01
    """Forward-backward check: tolerated squared mismatch as a share of the squared lengths of both
    flows.
    """
    consistency_absolute: Annotated[float, Ge(0)] = 0.5
    """Forward-backward check: tolerated squared mismatch of the shortest flows, px^2."""
