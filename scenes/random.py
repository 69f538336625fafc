"""A random scene for each seed, with its own rig and noise: it tests methods that are tuned to the other scenes."""

from __future__ import annotations

from morgs_mi.synth.random_scene import build

__all__ = ["build"]
