"""Synthetic captures: moving scenes, path-traced with exact ground truth."""
