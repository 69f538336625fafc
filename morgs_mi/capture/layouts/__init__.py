"""Readers of capture folders: COLMAP, Nerfstudio, Dynamic 3D Gaussians, poses_bounds.npy."""
