"""The rasteriser: projection, lists of pixel blocks, traced blending and its adjoint."""
