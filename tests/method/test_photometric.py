"""Photometric refinement: displacements of a fraction of a pixel and colours, from the images
alone.
"""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import SH_C0
from morgs_mi.method.motion import refine_start
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.render.rasterize import render_view
from tests.method.clump import STATIC, clump_and_wall
from tests.scenes.views import rendered_as

SHIFT = np.float32([0.05, -0.03, 0.02])  # two pixels
MOVING = 80


@pytest.fixture(scope="module")
def scene():
    gaussians, _, views = clump_and_wall(MOVING, 0.15, SHIFT, 128, 96)
    return gaussians, views


def with_colors(gaussians, change):
    return replace(gaussians, sh_coeffs=np.asarray(gaussians.sh_coeffs) + change)


def start(factor):
    displacement = np.zeros((MOVING + STATIC, 3), np.float32)
    displacement[:MOVING] = factor * SHIFT
    return MotionStart(displacement, np.full(len(displacement), 1.0, np.float32))


def refined_from(scene, start):
    return refine_start(MotionProblem(*scene, np.random.default_rng(0)), start)


def errors(lift):
    """Return the distances of the moving Gaussians from their true places, in lengths of SHIFT."""
    return np.linalg.norm(lift.displacement[:MOVING] - SHIFT, axis=1) / np.linalg.norm(SHIFT)


@pytest.mark.parametrize("factor", [0.6, 1.4])
def test_refine_start__corrects_what_flow_left(scene, factor):
    refined = refined_from(scene, start(factor))
    assert np.median(errors(refined)) < 0.1  # 0.4 at the start
    assert not refined.displacement[MOVING:].any()
    assert np.array_equal(refined.logit_confidence, start(factor).logit_confidence)


def test_refine_start__takes_no_step_longer_than_the_limit(scene, monkeypatch):
    gaussians, views = scene
    monkeypatch.setattr("morgs_mi.method.motion.LONGEST_PX", 0.1)
    step = refined_from(scene, start(0.6)).displacement - start(0.6).displacement
    px = [
        view.camera.projection_jacobian(np.asarray(gaussians.means)) @ step[..., None]
        for view in views.values()
    ]
    assert 0.05 < np.linalg.norm(px, axis=2).max() < 0.11


def color_change(gaussians, views):
    """Return the change of colour of Gaussians that do not move."""
    still = MotionStart.without_motion(gaussians)
    return refine_start(
        MotionProblem(gaussians, views, np.random.default_rng(0)), still
    ).color_change


def test_refine_start__follows_a_change_of_light(scene):
    gaussians, views = scene
    brighter = with_colors(gaussians, 0.1 / SH_C0)
    bright_views = rendered_as(brighter, views)
    followed = with_colors(gaussians, color_change(gaussians, bright_views)[:, None])
    differences = [
        [
            np.abs(view.target.difference(render_view(shown, view).color)).mean()
            for view in bright_views.values()
        ]
        for shown in (followed, gaussians)
    ]
    # The rest is at the border, and from the weight of ten pixels.
    assert max(differences[0]) < 0.5 * min(differences[1])


def test_refine_start__trusts_few_pixels_less(scene):
    gaussians, views = scene

    def followed(sizes):
        smaller = replace(gaussians, log_scales=np.asarray(gaussians.log_scales) + np.log(sizes))
        return np.median(
            color_change(smaller, rendered_as(with_colors(smaller, 0.1 / SH_C0), views))
        )

    assert followed(0.2) < 0.3 * followed(1.0)


def test_refine_start__takes_colours_where_the_step_leads(scene):
    gaussians, views = scene
    displaced = replace(gaussians, means=np.asarray(gaussians.means) + start(0.6).displacement)
    rest = color_change(displaced, views)[:MOVING]
    changes = refined_from(scene, start(0.6)).color_change[:MOVING]
    assert np.abs(changes).mean() < 0.3 * np.abs(rest).mean()
