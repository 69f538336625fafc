"""A scene that the seed draws afresh, rig and noise included: what is tuned to the other scenes is tested here."""

from __future__ import annotations

from morgs_mi.synth.random_scene import build

__all__ = ["build"]
