"""Readers of capture folders: COLMAP, Nerfstudio, Dynamic 3D Gaussians and poses_bounds.npy."""
