"""Cameras for Gaussians without a recording: they see an object completely and a scene upright,
whatever lies far outside of it.
"""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.playback.default_rig import default_rig, scene_box
from morgs_mi.testing import assert_close
from tests.scenes.changing_splats import splats


def rig_around(gaussians, axes="y-down"):
    """Return the cameras around the box of one frame."""
    return default_rig([gaussians], scene_box([gaussians]), axes)


@pytest.mark.parametrize(
    ("axes", "up"), [("y-down", (0, -1, 0)), ("y-up", (0, 1, 0)), ("z-up", (0, 0, 1))]
)
def test_default_rig__sees_the_gaussians_upright_from_all_sides(axes, up):
    cameras = rig_around(splats(300), axes)
    means = splats(300).numpy()["means"]
    for camera in cameras:
        pixels, depths = camera.project(means)
        assert depths.min() > 10 * camera.near
        assert np.mean(((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)) > 0.98
        assert_close(-camera.viewmat[1, :3], up, atol=1e-12)
        # The scene fills a good part of the image.
        assert max(np.ptp(pixels, axis=0) / [camera.width, camera.height]) > 0.45
    arms = np.stack([camera.position - cameras[0].position for camera in cameras])
    assert_close(arms @ up, np.zeros(8), atol=1e-12)
    named = {camera.name: camera for camera in cameras}
    across = (named["right"].position - named["left"].position) @ named["front"].viewmat[0, :3]
    assert across > 1


@pytest.mark.parametrize("side", ["right", "back-left"])
def test_default_rig__begins_where_the_scene_has_detail(side):
    toward = next(camera for camera in rig_around(splats(1)) if camera.name == side).viewmat[2, :3]
    steps = np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)), axis=-1).reshape(
        -1, 2
    )
    sheet = steps[:, :1] * np.cross(toward, (0, 1, 0)) + steps[:, 1:] * (0, 1, 0)
    colors = np.random.default_rng(0).uniform(-1.5, 1.5, (len(sheet), 1, 3))
    # A picture with a grey wall behind it.
    scene = Gaussians.from_activated(
        means=np.concatenate([sheet, sheet + 0.4 * toward]),
        scales=np.repeat([0.04, 0.15], len(sheet))[:, None] * np.ones(3),
        quats=np.tile([1.0, 0, 0, 0], (2 * len(sheet), 1)),
        opacities=np.full(2 * len(sheet), 0.99),
        sh_coeffs=np.concatenate([colors, 0 * colors]),
    )
    assert rig_around(scene)[0].name == side


def test_default_rig__ignores_far_floaters_and_what_is_nearly_transparent():
    scene = splats(300)
    raw = scene.numpy()
    means = raw["means"].copy()
    logits = raw["logit_opacities"].copy()
    means[:3] *= 1e4
    means[100:150] = 50
    logits[100:150] = -8
    shown = replace(scene, means=means, logit_opacities=logits)
    positions = (
        {camera.name: camera.position for camera in rig_around(gaussians)}
        for gaussians in (shown, scene)
    )
    assert_close(*(np.stack([rig[name] for name in sorted(rig)]) for rig in positions), atol=0.5)


def test_default_rig__sees_a_single_gaussian():
    for camera in rig_around(splats(1)):
        assert_close(camera.project(splats(1).numpy()["means"])[0], [[640, 360]], atol=1e-6)


def test_default_rig__sees_all_of_an_object():
    """The head of a figure has 3 % of its opacity."""
    rng = np.random.default_rng(0)
    body = rng.uniform((-0.2, 0, -0.1), (0.2, 1.5, 0.1), (970, 3))
    head = rng.uniform((-0.1, -0.3, -0.1), (0.1, 0, 0.1), (30, 3))
    figure = replace(splats(1000), means=np.concatenate([body, head]).astype(np.float32))
    figure = replace(figure, log_scales=figure.log_scales - 3)
    for camera in rig_around(figure):
        pixels, _ = camera.project(figure.numpy()["means"])
        margin = 0.02 * camera.height
        assert (pixels > margin).all()
        assert (pixels < [camera.width - margin, camera.height - margin]).all()
        assert np.ptp(pixels, axis=0)[1] > 0.7 * camera.height


def test_scene_box__leaves_out_the_surroundings_of_a_scene():
    around = np.random.default_rng(0).uniform(-8, 8, (60, 3))
    scene = splats(1000)
    means = np.concatenate([scene.numpy()["means"][60:], around]).astype(np.float32)
    low, high = scene_box([replace(scene, means=means)])
    assert (high - low < 4).all()
