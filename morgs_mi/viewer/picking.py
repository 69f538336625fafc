"""Picking: the Gaussian that dominates a pixel, and what it is."""

from __future__ import annotations

import numpy as np

from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.backproject import backproject
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.region import Region

__all__ = ["blend_weights", "description"]


def blend_weights(gaussians: Gaussians, camera: Camera, column: int, row: int, config: RenderConfig) -> np.ndarray:
    """Return the weights T alpha [N] (eq. 1) with which the renderer blends N Gaussians in a pixel."""
    pixel = np.zeros((camera.height, camera.width), bool)
    pixel[row, column] = True
    region = Region(pixel, config)
    return backproject(gaussians, camera, region.crop(pixel[..., None].astype(np.float32)), config, region)[:, 0]


def description(coded: CodedFrame, gaussian: int) -> str:
    """Return the attributes of the Gaussian with the number `gaussian` in a frame as Markdown."""
    rows = np.flatnonzero(coded.ids == gaussian)
    if not len(rows):
        return f"**Gaussian {gaussian}** does not exist in frame {coded.frame}."
    one = coded.gaussians.select(rows)
    raw = one.numpy()
    lines = [f"**Gaussian {gaussian}** of {len(coded)}", f"position {_vector(raw['means'][0])}"]
    lines.append(f"opacity {np.asarray(one.opacities)[0]:.2f}")
    if one.logit_confidence is not None:
        lines.append(f"confidence {np.asarray(one.confidence)[0]:.2f}")
    if "motion" in raw:
        motion = raw["motion"][0]
        lines.append(f"motion {_vector(motion)}, {np.linalg.norm(motion):.3g} units per frame")
    return "  \n".join(lines)  # two spaces: a line break


def _vector(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
