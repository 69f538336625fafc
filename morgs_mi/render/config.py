"""The renderer's settings: cut-offs and block shape."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from morgs_mi.core.checks import check_number

__all__ = ["RenderConfig"]


@dataclass(frozen=True)
class RenderConfig:
    """Settings of the rasteriser. The defaults are those of 3DGS, so that its models look right."""

    eps2d: float = 0.3
    """Low-pass filter in px^2 added to the projected covariance, so that no splat falls between pixels."""
    alpha_min: float = 1.0 / 255.0
    """A Gaussian whose alpha at a pixel is below this is skipped there: it cannot change an 8-bit image."""
    alpha_max: float = 0.99
    """Alpha is capped here, so that 1 / (1 - alpha) in the adjoint stays bounded."""
    stop_transmittance: float = 1e-4
    """A block ends when its most transparent pixel falls below this; bounds the error of the colour."""
    block_width: int | None = None
    """Width in pixels of the block that one SIMD lane owns: 4, 8, 12 or 16; None: 8 on the CPU, 4 on the GPU."""
    block_height: int | None = None
    """Height in pixels of that block, 1 to 16; None: 4."""
    reproducible: bool = False
    """Sum gradients in a fixed order: the same bytes on every run and any number of threads. A step takes 1.9 to 2.4
    times as long (20k and 100k Gaussians, two cores), and 48 bytes for every pair of Gaussian and block."""

    def __post_init__(self) -> None:
        check_number("RenderConfig()", "eps2d", self.eps2d, "[0, 1e18]")  # beyond that, float32 overflows
        check_number("RenderConfig()", "alpha_max", self.alpha_max, "(0, 1)")
        check_number("RenderConfig()", "alpha_min", self.alpha_min, f"(0, {self.alpha_max})")
        check_number("RenderConfig()", "stop_transmittance", self.stop_transmittance, "[0, 1)")
        if not _is_one_of(self.block_width, (4, 8, 12, 16)):
            raise ValueError(
                f"RenderConfig(): `block_width` must be 4, 8, 12 or 16 px, got {self.block_width!r}; pixels are "
                "read and written in packets of 4."
            )
        if not _is_one_of(self.block_height, range(1, 17)):
            raise ValueError(
                f"RenderConfig(): `block_height` must be an integer from 1 to 16 px, got {self.block_height!r}; the "
                "block's pixels are unrolled."
            )


def _is_one_of(size: int | None, sizes: Container[int]) -> bool:
    """Return whether a size is None, or an integer out of `sizes`: 8.0 and True are none."""
    return size is None or (type(size) is int and size in sizes)
