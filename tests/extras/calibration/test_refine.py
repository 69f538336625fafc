"""Refinement of cameras: with splats of a known scene, and on textured planes with exact images."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.view import Views
from morgs_mi.extras.calibration.bundle import changed_camera
from morgs_mi.extras.calibration.refine import (
    Refinement,
    RefinementProblem,
    refine_cameras,
)
from morgs_mi.fit.fit_config import FitConfig, ShortFitConfig
from morgs_mi.fit.view import rendered, withheld_blocks
from morgs_mi.platform.progress import Progress
from morgs_mi.playback.visualise import write_png
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.runs.fit_capture import with_points
from morgs_mi.testing import assert_close
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic

# Too little to find a gain.
LEAST = FitConfig(refine_cameras="auto", short_fits=ShortFitConfig(gaussians=50, steps=2, width=40))
WRONG = np.array([0.006, -0.008, 0.004, 0.01, 0.008, -0.01, 0.004, 0, 0, 0, 0])
PLACES = [(x, y, -4) for x, y in ((-1, 0), (0, 0.5), (1, 0), (0, -0.7))]
CAMERAS = look_at_cameras(PLACES, 60, 64, 48)


def splats():
    """Return a cloud of coloured splats."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (60, 3))
    sh = rng.uniform(-1, 1.5, (60, 1, 3))
    return isotropic(means.astype(np.float32), 0.15, 0.9, sh.astype(np.float32))


def image_of(camera):
    return np.rint(255 * rendered(splats(), camera, RenderConfig())).astype(np.uint8)


def wrong_changes(count):
    """Return changes [count, 11] to wrong poses and focal lengths."""
    return WRONG * np.random.default_rng(1).choice([-1, 1], (count, 11))


def disturbed(cameras, scale=1.0):
    """Return cameras with wrong poses and focal lengths."""
    return list(map(changed_camera, cameras, scale * wrong_changes(len(cameras))))


def turn_error(cameras, true):
    """Return the largest error of an angle between two viewing directions, degrees."""
    rays = (np.array([camera.viewmat[2, :3] for camera in rig]) for rig in (cameras, true))
    angles = [np.arccos(np.clip(r @ r.T, -1, 1)) for r in rays]
    return np.rad2deg(np.abs(angles[0] - angles[1]).max())


@pytest.fixture(scope="module")
def splat_capture(tmp_path_factory):
    """A capture of the splats in five views, the first of which is held out."""
    path = tmp_path_factory.mktemp("splats")
    cameras = look_at_cameras([(0, 0, -4), *PLACES], 60, 64, 48)
    means = np.asarray(splats().means)
    write_colmap(path / "sparse", cameras, means, np.full(means.shape, 0.5))
    for camera in cameras:
        write_png(path / camera.name / "0000.png", image_of(camera))
    return load_capture(path, test_view=0)


@pytest.fixture
def matched(monkeypatch):
    """Changes of cameras in place of those by features, which splats do not have."""
    monkeypatch.setattr(
        RefinementProblem, "matched", lambda self: (wrong_changes(len(self.views)), 100)
    )


@pytest.mark.parametrize(("gain", "accepted"), [(0.05, False), (0.2, True)])
def test_refine_cameras__takes_cameras_with_which_withheld_pixels_gain(
    splat_capture, matched, monkeypatch, gain, accepted
):
    scores = iter((25.0, 25.0 + gain))
    monkeypatch.setattr("morgs_mi.extras.calibration.refine.mean_psnr", lambda *_: next(scores))
    refined, refinement = refine_cameras(splat_capture, LEAST)
    assert refinement.taken is accepted
    assert ("stay as calibrated" in refinement.sentence) is not accepted
    assert (refined is splat_capture) is not accepted
    assert refined.cameras[0] is splat_capture.cameras[0], "the held-out view stays as calibrated"
    assert np.array_equal(refined.points, splat_capture.points) is not accepted


def test_refine_cameras__compares_the_views_that_have_withheld_pixels(
    splat_capture, matched, monkeypatch
):
    """Small views may have none."""

    def with_an_empty_view(views, width, rng):
        rest, unseen = withheld_blocks(views, width, rng)
        return rest, [
            replace(unseen[0], mask=np.zeros(unseen[0].image.shape[:2], bool)),
            *unseen[1:],
        ]

    monkeypatch.setattr("morgs_mi.extras.calibration.refine.withheld_blocks", with_an_empty_view)
    _, refinement = refine_cameras(splat_capture, LEAST)
    assert np.isfinite(refinement.calibrated_psnr)


@pytest.mark.long
def test_refine_cameras__improves_withheld_pixels_of_disturbed_cameras(textured_capture):
    wrong = disturbed(textured_capture.cameras, 1.5)
    disturbed_capture = textured_capture.with_cameras(wrong)
    capture = with_points(disturbed_capture, 0, Progress())
    how = ShortFitConfig(steps=200, width=160)
    refined, refinement = refine_cameras(capture, FitConfig(refine_cameras="auto", short_fits=how))
    assert refinement.taken
    assert refinement.refined_psnr > refinement.calibrated_psnr + 0.5
    true, start, result = (
        [c.cameras[v] for v in capture.train_views] for c in (textured_capture, capture, refined)
    )
    assert turn_error(result, true) < 0.2 * turn_error(start, true)


def test_refine_cameras__does_not_judge_where_refined_cameras_are_wanted(splat_capture, matched):
    refined, refinement = refine_cameras(splat_capture, replace(LEAST, refine_cameras="on"))
    assert refinement.taken
    assert np.isnan(refinement.calibrated_psnr)
    assert refined is not splat_capture


@pytest.mark.parametrize("mode", ["auto", "on"])
def test_refine_cameras__keeps_cameras_with_few_features(splat_capture, mode):
    refined, refinement = refine_cameras(splat_capture, replace(LEAST, refine_cameras=mode))
    assert refined is splat_capture
    assert refinement.sentence == (
        "The cameras stay as calibrated: a camera shares too few features with others to be "
        "refined."
    )


def changes_of(capture):
    """Return the changes of the training cameras by features, and the number of tracks."""
    return RefinementProblem.of(capture, FitConfig(), RenderConfig(), 0).matched()


@pytest.mark.slow
def test_matched__finds_the_cameras_by_features(textured_capture, monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.features.MAX_FEATURES", 300)
    capture = textured_capture.with_cameras(disturbed(textured_capture.cameras))
    start, true = ([c.cameras[v] for v in capture.train_views] for c in (capture, textured_capture))
    changes, tracks = changes_of(capture)
    cameras = list(map(changed_camera, start, changes))
    assert tracks > 100
    assert turn_error(cameras, true) < 0.1 * turn_error(start, true)


@pytest.mark.slow
def test_matched__finds_the_distortion_that_is_left(textured_capture, monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.features.MAX_FEATURES", 300)
    terms = [(0.08 * (-1) ** v, 0.0) for v in range(len(textured_capture.cameras))]
    bent = textured_capture.with_cameras(textured_capture.cameras, terms)
    changes, _ = changes_of(bent)
    # Images that were undistorted without need have the opposite distortion.
    assert_close(changes[:, 9], [-terms[v][0] for v in bent.train_views], atol=0.03)


def test_refine_cameras__needs_two_images(splat_capture):
    alone = replace(splat_capture, views=Views(splat_capture.views[:1])).holding_out(None)
    with pytest.raises(ValueError, match="at least two training views, got 1"):
        refine_cameras(alone, LEAST)


def test_Refinement__reports_the_changes_and_the_gain():
    refinement = Refinement(True, 26.0, 31.5, 200, 0.51, 0.02, 0.011, 0.003)
    assert refinement.sentence == (
        "The cameras were refined, by up to 0.51 degrees, 0.02 units, 1.1 % of the focal length "
        "and 0.3 % of the image's width by the lens: withheld pixels have 31.50 dB instead of "
        "26.00 dB."
    )
    assert "dB" not in replace(refinement, calibrated_psnr=np.nan, refined_psnr=np.nan).sentence
