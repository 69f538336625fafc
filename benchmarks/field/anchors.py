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

import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.spatial import KDTree

from benchmarks.field.shared import summed_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import MOTION_MODELS, MotionModelFactory
from morgs_mi.playback.export.clips import z_order

# Gaussians per anchor of each level, m r^l.
_COUNTS = (4, 12, 36)
# In scene extents.
_TRANSLATION_STEP = 1e-4
_ROTATION_STEP = 0.01


@MOTION_MODELS.register("anchors")
def anchored_motion(argument: str, config: MotionConfig) -> MotionModelFactory:
    """Return the factory of the model."""
    return lambda gaussians, extent, rng: summed_motion(
        anchor_matrix(np.asarray(gaussians.means)), extent, _TRANSLATION_STEP, _ROTATION_STEP
    )


def anchor_matrix(points: np.ndarray) -> csr_array:
    """Return which anchors of all levels each of N points [N, 3] follows, [N, A] of 0 and 1.

    Anchors are points at equal distances along a Z-order curve through all of them.
    """
    order = np.argsort(z_order(points), kind="stable")
    levels = []
    for count in _COUNTS:
        anchors = points[order[min(count, len(points)) // 2 :: count]]
        _, nearest = KDTree(anchors).query(points, workers=-1)
        values = np.ones(len(points), np.float32), nearest, np.arange(len(points) + 1)
        levels.append(csr_array(values, (len(points), len(anchors))))
    return csr_array(hstack(levels, format="csr"))
