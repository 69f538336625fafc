"""The ground truth against independent computations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.studio.synth.ground_truth import compute_ground_truth
from morgs_mi.studio.synth.path_tracer import PathTracer
from morgs_mi.studio.synth.scene import Object, Scene, load_scene, translate
from tests.assertions import assert_close
from tests.studio.synth.frames import psnr, render_frame


@pytest.fixture(scope="module")
def pair(tracer):
    camera = tracer.scene.rig.cameras(3, 320, 240)[1]
    return camera, render_frame(tracer, camera, 4), render_frame(tracer, camera, 5)


@pytest.mark.slow
def test_compute_ground_truth__motion_map_warps_the_previous_frame_onto_the_current_one(pair):
    _, (previous_image, truth_before), (image, truth) = pair
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float32)
    source = grid - truth.motion
    # Visible in both frames: all neighbours of the source belong to the same object.
    corners = [np.floor(source).astype(int) + corner for corner in ((0, 0), (0, 1), (1, 0), (1, 1))]
    ids = [
        truth_before.ids[np.clip(c[..., 1], 0, 239), np.clip(c[..., 0], 0, 319)] for c in corners
    ]
    same = truth.mask & (np.stack(ids) == truth.ids).all(axis=0)
    same = cv2.erode(same.astype(np.uint8), np.ones((3, 3))) > 0
    assert same.sum() > 5000

    def score(motion: np.ndarray) -> float:
        warped = cv2.remap(previous_image, grid - motion, None, cv2.INTER_CUBIC)
        return psnr(warped[same], image[same])

    # Resampling and changes of shading limit the score to 31 dB, of which noise costs 0.2 dB
    # (measured).
    assert score(truth.motion) > 29
    for wrong in (
        0 * truth.motion,
        -truth.motion,
        truth.motion + np.float32([0.5, 0]),
        truth.motion[..., ::-1],
    ):
        assert score(wrong) < score(truth.motion) - 1.5


@pytest.mark.slow
def test_compute_ground_truth__only_moving_objects_have_motion(pair, tracer):
    _, _, (_, truth) = pair
    moves = np.array([item.pose is not None for item in tracer.scene.objects.values()])
    assert (truth.ids >= 0).all()
    np.testing.assert_array_equal(truth.mask, moves[truth.ids])
    assert (truth.motion[~moves[truth.ids]] == 0).all()
    assert 2 < np.linalg.norm(truth.motion[truth.mask], axis=-1).mean() < 6


@pytest.mark.slow
def test_compute_ground_truth__first_frame_has_no_motion_and_the_mask_of_the_next_step(clip):
    first, second = (load_truth(clip / "truth", "cam01", frame) for frame in (0, 1))
    assert (first.motion == 0).all()
    assert first.mask.any()
    assert (first.mask == np.isin(first.ids, np.unique(second.ids[second.mask]))).all()


@pytest.mark.slow
def test_load_tracks__tracks_reproject_to_the_motion_map(clip):
    tracks = load_tracks(clip / "truth")
    assert tracks.points.shape == (len(tracks.ids), 3, 3)
    compared = 0
    for camera in load_scene("arm").rig.cameras(3, 64, 48):
        for frame in (1, 2):
            truth = load_truth(clip / "truth", camera.name, frame)
            pixels, depth = camera.project(tracks.points[:, frame])
            old_pixels, _ = camera.project(tracks.points[:, frame - 1])
            # Points that were sampled at a pixel centre of this view and frame.
            col, row = (np.floor(pixels).astype(int) * [1, 1]).T
            at_centre = np.abs(pixels - np.floor(pixels) - 0.5).max(axis=1) < 1e-3
            at_centre &= (col >= 0) & (col < 64) & (row >= 0) & (row < 48)
            col = np.clip(col, 0, 63)
            row = np.clip(row, 0, 47)
            at_centre &= np.abs(depth - truth.depth[row, col]) < 1e-4
            np.testing.assert_array_equal(truth.ids[row, col][at_centre], tracks.ids[at_centre])
            assert_close(
                (pixels - old_pixels)[at_centre], truth.motion[row, col][at_centre], atol=2e-3
            )
            compared += int((truth.mask[row, col] & at_centre).sum())
    assert compared > 100


def test_compute_ground_truth__marks_pixels_without_a_surface():
    square = {"type": "rectangle"}
    scene = Scene(
        "square", {"square": Object({"square": square}, lambda t: translate(t, 0.8, 0))}, {}
    )
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(2, 64, 48)[0]
    truth = compute_ground_truth(
        camera, tracer.surface_points(camera), tracer.poses(0), None, tracer.poses(1)
    )
    assert set(np.unique(truth.ids)) == {-1, 0}
    nothing = truth.ids < 0
    assert (truth.depth[nothing] == 0).all()
    assert not truth.mask[nothing].any()
    assert truth.mask[~nothing].all()
