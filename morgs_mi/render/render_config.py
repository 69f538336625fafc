"""The renderer's settings: cut-offs and block shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from morgs_mi.core.ranges import Above, AtLeast, AtMost, Below, MultipleOf, check_ranges

__all__ = ["RenderConfig"]


@dataclass(frozen=True)
class RenderConfig:
    """Settings of the rasteriser. The defaults are those of 3DGS, so that its models look right."""

    eps2d: Annotated[float, AtLeast(0), AtMost(1e18)] = 0.3  # beyond, float32 overflows
    """Low-pass filter in px^2 added to the projected covariance, so that no splat falls between pixels."""
    alpha_min: Annotated[float, Above(0)] = 1.0 / 255.0
    """A Gaussian whose alpha at a pixel is below this is skipped there: it cannot change an 8-bit image."""
    alpha_max: Annotated[float, Above(0), Below(1)] = 0.99
    """Alpha is capped here, so that 1 / (1 - alpha) in the adjoint stays bounded."""
    stop_transmittance: Annotated[float, AtLeast(0), Below(1)] = 1e-4
    """A block ends when its most transparent pixel falls below this; bounds the error of the colour."""
    block_width: Annotated[int, AtLeast(4), AtMost(16), MultipleOf(4)] | None = None
    """Width in pixels of the block that one SIMD lane owns, which are read and written in packets of 4; None: 8 on the
    CPU, 4 on the GPU."""
    block_height: Annotated[int, AtLeast(1), AtMost(16)] | None = None
    """Height in pixels of that block, 1 to 16; None: 4."""
    reproducible: bool = False
    """Sum gradients in a fixed order: the same bytes on every run and any number of threads. A step takes 1.9 to 2.4
    times as long (20k and 100k Gaussians, two cores), and 48 bytes for every pair of Gaussian and block."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.alpha_min >= self.alpha_max:
            raise ValueError(
                f"RenderConfig(): `alpha_min` must be below `alpha_max` = {self.alpha_max}, got {self.alpha_min}."
            )
