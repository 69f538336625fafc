"""The ground truth against independent computations."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.extras.synth.ground_truth import compute_ground_truth
from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import Object, Scene, load_scene, translate
from tests.extras.synth.frames import render_frame


@pytest.mark.slow
def test_compute_ground_truth__motion_map_warps_the_previous_frame_onto_the_current_one(tracer):
    camera = tracer.scene.rig.cameras(3, 320, 240)[1]
    (previous_image, previous), (image, truth) = (
        render_frame(tracer, camera, frame) for frame in (4, 5)
    )
    moves = np.array([item.pose is not None for item in tracer.scene.objects.values()])
    assert (truth.ids >= 0).all()
    assert_array_equal(truth.mask, moves[truth.ids])
    assert (truth.motion[~truth.mask] == 0).all()
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float32)

    def warped(values, motion, interpolation):
        return cv2.remap(values, grid - motion, None, interpolation)

    # Visible in both frames: the source and its neighbours belong to the same object.
    source_ids = warped(previous.ids.astype(np.float32), truth.motion, cv2.INTER_LINEAR)
    same = truth.mask & (source_ids == truth.ids)
    same = cv2.erode(same.astype(np.uint8), np.ones((3, 3))) > 0
    assert same.sum() > 5000
    offset = np.float32([0.5, 0])
    scores = [
        psnr(warped(previous_image, motion, cv2.INTER_CUBIC), image, same)
        for motion in (truth.motion, -truth.motion, truth.motion + offset, truth.motion[..., ::-1])
    ]
    # Resampling and changes of shading limit the score to 31 dB, of which noise costs 0.2 dB
    # (measured).
    assert scores[0] > 29
    assert max(scores[1:]) < scores[0] - 1.5


@pytest.mark.slow
def test_compute_ground_truth__first_frame_has_no_motion_and_the_mask_of_the_next_step(clip):
    first, second = (load_truth(clip / "truth", "cam01", frame) for frame in (0, 1))
    assert (first.motion == 0).all()
    assert first.mask.any()
    assert (first.mask == np.isin(first.ids, np.unique(second.ids[second.mask]))).all()


@pytest.mark.slow
def test_load_tracks__visible_points_are_on_the_surfaces(clip):
    """They have the depth of their pixel, up to its slope."""
    tracks = load_tracks(clip / "truth")
    camera = load_scene("arm").rig.cameras(3, 64, 48)[1]
    truth = load_truth(clip / "truth", camera.name, 2)
    visible = tracks.visible[camera.name][:, 2]
    pixels, depth = camera.project(tracks.points[visible, 2])
    column, row = np.floor(pixels).astype(int).T
    assert visible.sum() > 500
    assert np.mean(np.abs(depth / truth.depth[row, column] - 1) < 0.03) > 0.95


def test_compute_ground_truth__marks_pixels_without_a_surface():
    square = Object({"square": {"type": "rectangle"}}, lambda t: translate(t, 0.8, 0))
    tracer = PathTracer(Scene("square", {"square": square}, {}))
    camera = tracer.scene.rig.cameras(2, 64, 48)[0]
    truth = compute_ground_truth(
        camera, tracer.surface_points(camera), tracer.poses(0), None, tracer.poses(1)
    )
    assert set(np.unique(truth.ids)) == {-1, 0}
    assert (truth.depth[truth.ids < 0] == 0).all()
    assert_array_equal(truth.mask, truth.ids == 0)
