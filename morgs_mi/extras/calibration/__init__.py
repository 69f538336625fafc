"""Cameras from videos by COLMAP, and checks of given poses."""
