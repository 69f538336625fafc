"""The renderer's settings: cut-offs and block shape."""

from __future__ import annotations

from dataclasses import dataclass

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
        if self.block_width not in (None, 4, 8, 12, 16):
            raise ValueError(
                f"RenderConfig(): `block_width` must be 4, 8, 12 or 16 px, got {self.block_width}; pixels are read and "
                "written in packets of 4."
            )
        if self.block_height is not None and not 1 <= self.block_height <= 16:
            raise ValueError(
                f"RenderConfig(): `block_height` must be 1 to 16 px, got {self.block_height}; the block's pixels are "
                "unrolled."
            )
