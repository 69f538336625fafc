"""Refinement of cameras: with splats of a known scene, and on textured planes with exact images."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.rig import scene_extent
from morgs_mi.core.view import View, Views
from morgs_mi.extras.calibration.bundle import changed_camera, prior_deviations
from morgs_mi.extras.calibration.refine import (
    Refinement,
    _joint_step,
    _matched,
    refine_cameras,
    register_camera,
)
from morgs_mi.fit.fit_config import CameraPriors, FitConfig, ShortFitConfig
from morgs_mi.fit.view import rendered, withheld_blocks
from morgs_mi.platform.progress import Progress
from morgs_mi.playback.visualise import to_uint8, write_png
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.runs.fit_capture import with_points
from morgs_mi.testing import assert_close
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic

# Too little to find a gain.
LEAST = FitConfig(
    refine_cameras="auto", short_fits=ShortFitConfig(gaussians=50, steps=2, rounds=1, width=40)
)
SHORT = ShortFitConfig(gaussians=300, steps=200, rounds=3, width=96)
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


def disturbed(cameras, scale=1.0):
    """Return cameras with wrong poses and focal lengths."""
    signs = np.random.default_rng(1).choice([-1, 1], (len(cameras), 11))
    return [changed_camera(c, scale * s * WRONG) for c, s in zip(cameras, signs, strict=True)]


def turn_error(cameras, true):
    """Return the largest error of an angle between two viewing directions, degrees."""
    rays = (np.array([camera.viewmat[2, :3] for camera in rig]) for rig in (cameras, true))
    angles = [np.arccos(np.clip(r @ r.T, -1, 1)) for r in rays]
    return np.rad2deg(np.abs(angles[0] - angles[1]).max())


def capture_of(path, gaussians, cameras, test_view, noise=0.0):
    """Return a capture of Gaussians with noisy images; `noise` is a deviation in grey levels."""
    rng = np.random.default_rng(0)
    means = np.asarray(gaussians.means)
    write_colmap(path / "sparse", cameras, means, np.full(means.shape, 0.5))
    for camera in cameras:
        image = rendered(gaussians, camera, RenderConfig())
        image = image + rng.normal(scale=noise / 255, size=image.shape)
        write_png(path / camera.name / "0000.png", to_uint8(image))
    return load_capture(path, test_view=test_view)


@pytest.fixture(scope="module")
def splat_capture(tmp_path_factory):
    """A capture of the splats in five views, the first of which is held out."""
    cameras = look_at_cameras([(0, 0, -4), *PLACES], 60, 64, 48)
    return capture_of(tmp_path_factory.mktemp("splats"), splats(), cameras, test_view=0)


@pytest.fixture(scope="module")
def far_capture(tmp_path_factory):
    """A capture of distant splats in nine noisy views on a plane, the middle one of which is held
    out.
    """
    rng = np.random.default_rng(0)
    means = rng.uniform((-3, -2.2, 6), (3, 2.2, 12), (150, 3))
    sh = rng.uniform(-1, 1.5, (150, 1, 3))
    gaussians = isotropic(means.astype(np.float32), 0.35, 0.9, sh.astype(np.float32))
    places = [(x, y, 0) for y in (-0.5, 0, 0.5) for x in (-1, 0, 1)]
    cameras = look_at_cameras(places, 45, 96, 72, target=(0, 0, 10))
    return capture_of(tmp_path_factory.mktemp("far"), gaussians, cameras, test_view=4, noise=5)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.0, 1.0])
@pytest.mark.parametrize("seed", [1, 3])
def test_refine_cameras__stays_in_the_frame_of_what_takes_no_part(far_capture, scale, seed):
    """Noise alone moves correct cameras by 0.2 to 0.3 px; disturbed ones show the splats 0.6 to 0.8
    px off.
    """
    deviations = scale * np.array([0.005] * 3 + [0.006] * 3 + [0.008, 0, 0, 0, 0])
    errors = deviations * np.random.default_rng(seed).normal(size=(9, 11))
    errors[list(far_capture.test_views)] = 0
    capture = far_capture.with_cameras(list(map(changed_camera, far_capture.cameras, errors)))
    config = FitConfig(refine_cameras="on", short_fits=replace(SHORT, steps=100))
    refined, _ = refine_cameras(capture, config, RenderConfig(), seed)
    # The positions of the splats in training cameras.
    pixels, old_pixels, new_pixels = (
        np.array([each.cameras[v].project(far_capture.points)[0] for v in each.train_views])
        for each in (far_capture, capture, refined)
    )
    old_shift, new_shift = (
        np.median(np.linalg.norm(each - pixels, axis=-1)) for each in (old_pixels, new_pixels)
    )
    assert new_shift < max(0.35, 0.9 * old_shift)


def test_joint_step__turns_cameras_to_where_the_images_were_taken():
    start = disturbed(CAMERAS)
    gaussians = splats()
    changes = np.zeros((4, 11))
    views = [View(camera, image_of(true)) for camera, true in zip(start, CAMERAS, strict=True)]
    deviations = prior_deviations(1.0, CameraPriors())
    for _ in range(8):
        gaussians, changes = _joint_step(gaussians, views, changes, deviations, 0.0, RenderConfig())
    cameras = list(map(changed_camera, start, changes))
    assert turn_error(cameras, CAMERAS) < 0.15 * turn_error(start, CAMERAS)
    assert abs(changes[:, 6].mean()) < 1e-6, "a camera that takes no part keeps its focal length"


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_register_camera__finds_the_camera_of_an_image(scale):
    start = disturbed(CAMERAS[:1], scale)[0]
    image = image_of(CAMERAS[0])
    camera = register_camera(splats(), View(start, image), 1.0, FitConfig(), RenderConfig())
    error = np.square(rendered(splats(), camera, RenderConfig()) - image / 255).mean()
    assert error < 1e-5, "the rounding to 8 bits alone has 1e-6"


@pytest.mark.parametrize(("gain", "accepted"), [(0.05, False), (0.2, True)])
def test_refine_cameras__takes_cameras_with_which_withheld_pixels_gain(
    splat_capture, monkeypatch, gain, accepted
):
    scores = iter((25.0, 25.0 + gain))
    monkeypatch.setattr("morgs_mi.extras.calibration.refine.mean_psnr", lambda *_: next(scores))
    refined, refinement = refine_cameras(splat_capture, LEAST)
    assert refinement.taken is accepted
    assert ("stay as calibrated" in refinement.sentence) is not accepted
    assert (refined is splat_capture) is not accepted
    assert refined.cameras[0] is splat_capture.cameras[0], "the held-out view stays as calibrated"
    assert np.array_equal(refined.points, splat_capture.points) is not accepted


def test_refine_cameras__compares_the_views_that_have_withheld_pixels(splat_capture, monkeypatch):
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
    disturbed_capture = replace(
        textured_capture, cameras=tuple(disturbed(textured_capture.cameras, 1.5))
    )
    capture = with_points(disturbed_capture, 0, Progress())
    how = ShortFitConfig(steps=200, rounds=2, width=160)
    refined, refinement = refine_cameras(capture, FitConfig(refine_cameras="auto", short_fits=how))
    assert refinement.taken
    assert refinement.refined_psnr > refinement.calibrated_psnr + 0.5
    true, start, result = (
        [c.cameras[v] for v in capture.train_views] for c in (textured_capture, capture, refined)
    )
    assert turn_error(result, true) < 0.5 * turn_error(start, true), "two rounds of five"


def test_refine_cameras__does_not_judge_where_refined_cameras_are_wanted(splat_capture):
    refined, refinement = refine_cameras(splat_capture, replace(LEAST, refine_cameras="on"))
    assert refinement.taken
    assert np.isnan(refinement.calibrated_psnr)
    assert refined is not splat_capture


def matched(capture):
    """Return the changes of the training cameras by features, and the number of tracks."""
    extent = scene_extent([capture.cameras[v] for v in capture.train_views])
    deviations = prior_deviations(extent, CameraPriors())
    return _matched(capture, capture.train_views, deviations)[:2]


@pytest.mark.slow
def test_matched__finds_the_cameras_by_features(textured_capture, monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.features.MAX_FEATURES", 300)
    capture = textured_capture.with_cameras(disturbed(textured_capture.cameras))
    start, true = ([c.cameras[v] for v in capture.train_views] for c in (capture, textured_capture))
    changes, tracks = matched(capture)
    cameras = list(map(changed_camera, start, changes))
    assert tracks > 100
    assert turn_error(cameras, true) < 0.1 * turn_error(start, true)


@pytest.mark.slow
def test_matched__finds_the_distortion_that_is_left(textured_capture, monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.features.MAX_FEATURES", 300)
    terms = [(0.08 * (-1) ** v, 0.0) for v in range(len(textured_capture.cameras))]
    bent = textured_capture.with_cameras(textured_capture.cameras, terms)
    changes, _ = matched(bent)
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
