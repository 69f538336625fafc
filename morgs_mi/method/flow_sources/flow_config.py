"""Settings of optical flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from morgs_mi.core.documentation import documented
from morgs_mi.core.ranges import AtLeast, check_ranges


@documented
@dataclass(frozen=True)
class FlowConfig:
    """Settings of OpenCV's methods and of the forward-backward check.

    Raises:
        ValueError: a number is out of range.
    """

    fine_width: Annotated[int, AtLeast(0)] = 480
    """Width in pixels up to which `dis` goes to full resolution; in wider images it stops at half
    resolution.
    """
    consistency_relative: Annotated[float, AtLeast(0)] = 0.01
    """Forward-backward check: tolerated squared mismatch as a share of the squared lengths of both
    flows.
    """
    consistency_absolute: Annotated[float, AtLeast(0)] = 0.5
    """Forward-backward check: tolerated squared mismatch of the shortest flows, px^2."""

    def __post_init__(self) -> None:
        check_ranges(self)
