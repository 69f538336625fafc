"""Motion of anchors: which Gaussians follow which anchor, and sums of rounded motions."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from benchmarks.field.anchors import AnchorConfig, anchor_matrix, anchored_motion
from tests.assertions import assert_close
from tests.scenes.gaussians import make_wide_scene, to_gaussians


def test_anchor_matrix__lets_points_follow_one_near_anchor_of_each_level():
    points = np.random.default_rng(0).uniform(-1, 1, (600, 3)) ** 3  # dense in the middle
    followed, size = anchor_matrix(points, [4, 12])
    assert followed.shape == (600, size) == (600, 150 + 50)
    for level in (followed[:, :150], followed[:, 150:]):
        assert (level.sum(axis=1) == 1).all()
    per_anchor = followed[:, :150].sum(axis=0)
    assert per_anchor.min() >= 1
    assert per_anchor.max() <= 20  # where points are dense, there are more anchors


def test_anchor_matrix__has_one_anchor_for_points_fewer_than_asked_for():
    assert anchor_matrix(np.zeros((3, 3)), [4, 12])[0].toarray().tolist() == [[1, 1]] * 3


def test_anchored_motion__sums_the_rounded_motions_of_the_levels():
    gaussians = to_gaussians(make_wide_scene())
    config = AnchorConfig(
        levels=2, gaussians=2, ratio=10**6, translation_step=0.1, rotation_step=0.25
    )
    model = anchored_motion(gaussians, 2.0, config)
    translation = np.zeros(tuple(model.parameters["translation"].shape), np.float32)
    rotation = np.zeros(tuple(model.parameters["rotation"].shape), np.float32)
    # Of the one anchor of the coarse level; the step is 0.2 world units.
    translation[-1] = (0.97, 0.09, -0.49)
    rotation[-1] = (0, 0.2, 0.1, 0.4)
    translations, turned = model.motion(
        {"translation": mi.TensorXf(translation), "rotation": mi.TensorXf(rotation)}
    )
    assert_close(np.asarray(translations), np.tile([1.0, 0, -0.4], (len(gaussians), 1)), atol=1e-6)
    assert_close(np.asarray(turned), np.tile([0, 0.25, 0, 0.5], (len(gaussians), 1)), atol=1e-6)
