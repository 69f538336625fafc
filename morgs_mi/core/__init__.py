"""Foundations of the renderer and the method: Gaussians, cameras, colours, geometry, arrays."""
