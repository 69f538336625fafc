"""Bundle adjustment: derivatives, and cameras from exact features with wrong matches among them."""

import numpy as np
import pytest

from morgs_mi.capture.lens import Lens, undistorted
from morgs_mi.core.rig import scene_extent
from morgs_mi.extras.calibration.bundle import (
    bundle_adjust,
    camera_jacobian,
    changed_camera,
    distorted,
    likely_deviations,
    prior_deviations,
)
from morgs_mi.fit.features import FeatureTracks, intersect
from morgs_mi.fit.fit_config import CameraPriors
from morgs_mi.testing import assert_close
from tests.scenes.cameras import look_at_cameras
from tests.scenes.textured import rig

POINTS = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 6), (300, 3))


DEVIATIONS = np.array([0.005] * 3 + [0.01] * 3 + [0.01, 0, 0, 0, 0])


def seen_by(cameras, points=POINTS):
    """Return the exact features of all points in all cameras."""
    views, ids = (grid.ravel() for grid in np.mgrid[: len(cameras), : len(points)])
    pixels = np.concatenate([camera.project(points)[0] for camera in cameras])
    return FeatureTracks(ids, views, pixels, np.zeros((len(ids), 3)))


def priors_of(cameras):
    return prior_deviations(scene_extent(cameras), CameraPriors())


def disturbed(cameras, rng):
    return [changed_camera(camera, DEVIATIONS * rng.normal(size=11)) for camera in cameras]


@pytest.mark.parametrize("distortion", [(0, 0), (-0.15, 0.04)])
def test_camera_jacobian__is_that_of_finite_differences(distortion):
    camera = rig(shift=7)[1]
    step = 1e-6
    start = np.array([0, 0, 0, 0.02, -0.01, 0.03, 0.02, 0.001, -0.002, *distortion])

    def seen(changes, points=POINTS):
        changed_view = changed_camera(camera, changes)
        return distorted(changed_view, changed_view.project(points)[0], changes[9:])

    of_changes, of_points = camera_jacobian(changed_camera(camera, start), 1.02, POINTS, start[9:])
    for k in range(11):
        ahead, back = (seen(start + sign * step * np.eye(11)[k]) for sign in (1, -1))
        assert_close(
            of_changes[:, :, k], (ahead - back) / (2 * step), rtol=1e-5, atol=1e-4, name=str(k)
        )
    ends = [seen(start, POINTS + sign * step * np.eye(3)[0]) for sign in (1, -1)]
    assert_close(of_points[:, :, 0], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-4)


def test_distorted__is_inverted_by_the_lens():
    camera = rig()[0]
    k = np.array([-0.12, 0.03])
    pixels = np.random.default_rng(0).uniform(0, (camera.width, camera.height), (50, 2))
    lens = Lens("RADIAL", tuple(k))
    assert_close(undistorted(camera, lens, distorted(camera, pixels, k)), pixels, atol=1e-6)


def test_bundle_adjust__finds_the_reprojections_despite_wrong_matches():
    true = rig(shift=7)
    rng = np.random.default_rng(1)
    tracks = seen_by(true)
    start = disturbed(true, rng)
    wrong = rng.random(len(tracks.ids)) < 0.1
    tracks.pixels[wrong] += rng.normal(scale=30, size=(wrong.sum(), 2))
    changes, points = bundle_adjust(start, tracks, priors_of(start))
    assert np.abs(changes[:, 6]).max() > 1e-3
    assert abs(changes[:, 6].mean()) < 1e-6, "the mean focal length stays"
    cameras = [changed_camera(*pair) for pair in zip(start, changes, strict=True)]
    projected = np.concatenate([camera.project(points)[0] for camera in cameras])
    assert np.median(np.linalg.norm(projected - tracks.pixels, axis=1)[~wrong]) < 0.02
    relative = [rig[0].viewmat[:3, :3] @ rig[-1].viewmat[:3, :3].T for rig in (cameras, true)]
    assert np.rad2deg(np.arccos((np.trace(relative[0].T @ relative[1]) - 1) / 2)) < 0.02


@pytest.mark.parametrize("seed", [3, 5])
def test_bundle_adjust__keeps_points_in_place_for_a_camera_that_takes_no_part(seed):
    places = [(x, y, 0) for y in (-0.5, 0, 0.5) for x in (-1, 0, 1)]
    rng = np.random.default_rng(seed)
    nine = look_at_cameras(places, 50, 320, 240, target=(0, 0, 10))
    rig_of_nine = nine[:4] + nine[5:]
    unseen = nine[4]
    points = rng.uniform((-3, -2, 6), (3, 2, 14), (300, 3))
    tracks = seen_by(rig_of_nine, points)
    tracks.pixels[:] += rng.normal(scale=0.3, size=tracks.pixels.shape)
    start = intersect(tracks.ids, tracks.views, tracks.pixels, rig_of_nine, tracks.count)
    _, end = bundle_adjust(rig_of_nine, tracks, priors_of(rig_of_nine))
    pixels = np.array([unseen.project(positions)[0] for positions in (points, start, end)])
    errors = np.median(np.linalg.norm(pixels[1:] - pixels[0], axis=2), axis=1)
    assert errors[1] < errors[0] + 0.03


@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.05), (3.0, 1.0)])
def test_likely_deviations__are_small_where_features_reproject_well(noise, most):
    tracks = seen_by(rig())
    tracks.pixels[:] += np.random.default_rng(0).normal(scale=noise, size=tracks.pixels.shape)
    shares = likely_deviations(rig(), tracks, priors_of(rig())) / priors_of(rig())
    assert 0.4 * most < shares.max() <= most
