"""Capture layouts of motion capture systems and of Dynamic 3D Gaussians."""
