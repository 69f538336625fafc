"""Motion of anchors at several levels, after ReCon-GS (Fu et al., NeurIPS 2025) and QuARC-GS
(2026).

The finest level has an anchor for every m Gaussians, and each further level a fraction 1/r of the
anchors before it. So anchors are dense where Gaussians are, unlike cells of one size. Every
Gaussian follows the nearest anchor a_l(i) of each level l, and moves by the sum of their
translations t and rotations q (eq. 2 of QuARC-GS):

    d_i = sum_l t_{a_l(i)},    r_i = 1 + sum_l q_{a_l(i)}.

Both are multiples of a step (its eq. 3): rounded in the forward pass, with the gradient of what is
not rounded. An anchor that would move by less than half a step does not move at all. A step of 0
rounds nothing, as in ReCon-GS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.spatial import KDTree

from benchmarks.field.shared import quantised
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    MotionModelFactory,
    sparse_product,
)
from morgs_mi.playback.export.clips import equal_cells, z_order


@dataclass(frozen=True)
class AnchorConfig:
    """Settings of the motion of anchors."""

    levels: int = 3
    """Levels L."""
    gaussians: int = 4
    """Gaussians per anchor of the finest level, m."""
    ratio: int = 3
    """Anchors of a level per anchor of the next coarser one, r."""
    translation_step: float = 1e-4
    """Step of the translations, in scene extents; 0: not rounded."""
    rotation_step: float = 0.01
    """Step of the rotations; 0: not rounded."""
    translation_rate: float = 4e-3
    """Learning rate of the translations at the start, in scene extents; it falls to a tenth."""
    rotation_rate: float = 8e-3
    """Learning rate of the rotations, likewise."""


def anchored_motion(gaussians: Gaussians, extent: float, config: AnchorConfig) -> MotionModel:
    """Return the model of N Gaussians of the previous frame; `extent` of the scene, world units."""
    counts = [config.gaussians * config.ratio**level for level in range(config.levels)]
    anchors, size = anchor_matrix(np.asarray(gaussians.means), counts)
    steps = {"translation": config.translation_step * extent, "rotation": config.rotation_step}
    return MotionModel(
        {
            "translation": dr.zeros(mi.TensorXf, (size, 3)),
            "rotation": dr.zeros(mi.TensorXf, (size, 4)),
        },
        {"translation": config.translation_rate * extent, "rotation": config.rotation_rate},
        lambda p: tuple(
            sparse_product(anchors, quantised(p[name], step)) for name, step in steps.items()
        ),
    )


@MOTION_MODELS.register("anchors")
def _anchors(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: anchored_motion(gaussians, extent, AnchorConfig())


def anchor_matrix(points: np.ndarray, counts: Sequence[int]) -> tuple[csr_array, int]:
    """Return which anchors each of N points follows, [N, A] of 0 and 1, and the number A of anchors
    of all levels.

    Anchors are points at equal distances along a Z-order curve through all of them.

    Args:
        points: [N, 3], world units.
        counts: points per anchor of each level.
    """
    order = np.argsort(z_order(points, equal_cells(points)), kind="stable")
    levels = []
    size = 0
    for count in counts:
        anchors = points[order[min(count, len(points)) // 2 :: count]]
        _, nearest = KDTree(anchors).query(points, workers=-1)
        rows = np.arange(len(points) + 1)
        levels.append(
            csr_array(
                (np.ones(len(points), np.float32), nearest, rows), (len(points), len(anchors))
            )
        )
        size += len(anchors)
    return csr_array(hstack(levels, format="csr")), size
