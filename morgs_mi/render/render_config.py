"""The renderer's settings: cut-offs and block shape."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt, MultipleOf

from morgs_mi.core.color_space import BRIGHTEST
from morgs_mi.platform.config import Positive, config_class

_Encoded = Annotated[float, Ge(-BRIGHTEST), Le(BRIGHTEST)]


@config_class
class RenderConfig:
    """Settings of the rasteriser. The defaults match 3DGS, because its models depend on them."""

    eps2d: Annotated[float, Ge(0), Le(1e18)] = 0.3  # beyond, float32 overflows
    """Low-pass filter in px^2, added to the projected covariance; it prevents splats from falling
    between pixels.
    """
    antialiased: bool = False
    """Reduce the opacity by what the low-pass filter adds to a splat's area, sqrt(det S / det (S +
    eps2d I)) (Yu et al. 2024): small splats fade instead of growing. For models that were trained
    so."""
    alpha_min: Positive = 1.0 / 255.0
    """Alpha below which a Gaussian is skipped at a pixel: it cannot change an 8-bit image."""
    alpha_max: Annotated[float, Gt(0), Lt(1)] = 0.99
    """Upper limit of alpha; it bounds 1 / (1 - alpha) in the adjoint."""
    stop_transmittance: Annotated[float, Ge(0), Lt(1)] = 1e-4
    """Transmittance of its most transparent pixel below which a block ends; bounds the error of the
    colour.
    """
    first_order_motion: bool = False
    """Draw motion to first order, J(mean) * motion, as in the MoRGS paper (eq. 6), instead of the
    difference of two projections. The relative difference is motion in depth / depth."""
    background: tuple[_Encoded, _Encoded, _Encoded] | None = None
    """Colour behind all Gaussians, encoded: 1 is white. None: black."""
    block_width: Annotated[int, Ge(4), Le(16), MultipleOf(4)] | None = None
    """Width in pixels of the block of one SIMD lane; pixels are read and written in packets of 4.
    None: 8 on the CPU, 4 on the GPU."""
    block_height: Annotated[int, Ge(1), Le(16)] | None = None
    """Height in pixels of that block, 1 to 16; None: 4."""

    def __post_init__(self) -> None:
        if self.alpha_min >= self.alpha_max:
            raise ValueError(
                f"RenderConfig(): `alpha_min` must be below `alpha_max` = {self.alpha_max}, got "
                f"{self.alpha_min}."
            )
