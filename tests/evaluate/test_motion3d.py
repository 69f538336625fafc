"""3D motion: assignment to objects, motion of objects, comparison of displacements."""

from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.motion3d import (
    compare_motion,
    evaluate_motion,
    rigid_motions,
    surface_ids,
)
from morgs_mi.testing import assert_close

rng = np.random.default_rng(0)
WIDTH = 40
HEIGHT = 30
FRONT = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 50, WIDTH, HEIGHT)
TURN = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
SHIFT = np.array([0.05, 0, -0.02])


def plane(depth, left, right):
    """Ground truth of a wall: object `left` in the left half of the image, `right` in the right
    half.
    """
    ids = np.where(np.arange(WIDTH) < WIDTH // 2, left, right) + np.zeros((HEIGHT, 1), int)
    return GroundTruth(
        np.zeros((HEIGHT, WIDTH, 2)),
        np.full((HEIGHT, WIDTH), depth),
        ids,
        np.zeros((HEIGHT, WIDTH), bool),
    )


def test_surface_ids__assigns_points_on_a_visible_surface_to_its_object():
    points = np.array(
        [(-0.5, 0, 0), (0.5, 0, 0.03), (-0.5, 0, -0.1), (0.5, 0, 0.1), (9, 0, 0), (0, 0, -9)]
    )
    # On, on within 1 % of the depth of 4, in front, behind, outside the image, behind the camera.
    assert surface_ids(points, [(FRONT, plane(4, 3, 5))]).tolist() == [3, 5, -1, -1, -1, -1]
    assert surface_ids(points, []).tolist() == [-1] * 6


def test_surface_ids__excludes_points_on_which_views_disagree_and_combines_the_others():
    points = np.array([(-0.5, 0, 0.0), (0.5, 0, 0.0)])
    assert surface_ids(points, [(FRONT, plane(4, 3, 5)), (FRONT, plane(4, 3, 6))]).tolist() == [
        3,
        -1,
    ]
    assert surface_ids(points, [(FRONT, plane(4, -1, 5)), (FRONT, plane(4, 3, 5))]).tolist() == [
        3,
        5,
    ]


def test_rigid_motions__are_recovered_from_tracks():
    points = rng.normal(size=(50, 3))
    ids = np.repeat([0, 2, 4, 5, 6], 10)
    points[ids == 5] *= (1, 0, 0)
    points[ids == 6] *= (1, 1, 0)  # in a plane
    moved_points = points.copy()
    rigid = np.isin(ids, (2, 6))
    moved_points[rigid] = points[rigid] @ TURN.T + SHIFT
    moved_points[ids == 4] *= 1.1  # it swells: not rigid
    moved_points[ids == 5] = points[ids == 5] + SHIFT  # on a line: a turn about it would not show
    motions = rigid_motions(points, moved_points, ids)
    assert list(motions) == [2, 6]
    for rotation, shift in motions.values():
        assert_close(rotation, TURN, atol=1e-12)
        assert_close(shift, SHIFT, atol=1e-12)


def test_compare_motion__of_known_displacements():
    truth = np.array([(1.0, 0, 0), (0, 3, 0)])
    score = compare_motion(np.array([(0, 1.0, 0), (0, 0, 0)]), truth)
    assert score.num_gaussians == 2
    assert score.error == pytest.approx((np.sqrt(2) + 3) / 2)
    assert score.true_length == 2
    assert score.relative_error == pytest.approx((np.sqrt(2) + 3) / 4)
    assert score.length_ratio == pytest.approx(0.25)
    assert score.angle == pytest.approx(90)
    assert compare_motion(-truth, truth).angle == pytest.approx(180)
    half = compare_motion(truth / 2, truth)
    assert (half.relative_error, half.length_ratio, half.angle) == pytest.approx((0.5, 0.5, 0))


def test_compare_motion__of_no_gaussian_is_nan():
    nothing = asdict(compare_motion(np.zeros((0, 3)), np.zeros((0, 3))))
    assert nothing.pop("num_gaussians") == 0
    assert np.isnan(list(nothing.values())).all()


def test_evaluate_motion__selects_opaque_gaussians_on_a_moving_object_off_its_axis():
    """The left half of the wall turns about the axis through (-1, 0, 0) along the view."""
    turn = Rotation.from_rotvec([0, 0, 0.2]).as_matrix()
    centre = np.array([-1.0, 0, 0])
    tracked = np.array(
        [(-1.6, 0, 0), (-0.4, 0, 0), (-1, 0.6, 0), (0.5, 0, 0), (0.6, 0, 0), (0.5, 0.1, 0)]
    )
    ids = np.array([3, 3, 3, 5, 5, 5])
    moved_points = np.where(ids[:, None] == 3, (tracked - centre) @ turn.T + centre, tracked)
    means = np.array([(-0.6, 0, 0), (-1.01, 0, 0), (-0.6, 0.2, 0), (0.5, 0, 0), (-0.6, 0, 1)])
    true = (means - centre) @ turn.T + centre - means
    opacities = np.array([0.9, 0.9, 0.05, 0.9, 0.9])
    views = [(FRONT, plane(4, 3, 5))]
    # Only the first is evaluated: on the axis, too transparent, on the static half, off the
    # surface.
    score = evaluate_motion(means, 1.5 * true, opacities, (tracked, moved_points, ids), views)
    assert score.num_gaussians == 1
    assert score.true_length == pytest.approx(2 * 0.4 * np.sin(0.1))
    assert (score.relative_error, score.length_ratio) == pytest.approx((0.5, 1.5))
    assert score.angle == pytest.approx(0, abs=1e-5)  # an arc cosine near 1 halves the digits
