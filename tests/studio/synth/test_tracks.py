"""Exact tracks of a synthetic clip: visibility against the ground truth of the views, and against a
known occluder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import Tracks, load_tracks, load_truth, save_tracks
from morgs_mi.studio.synth.path_tracer import PathTracer
from morgs_mi.studio.synth.scene import Object, Scene, translate
from morgs_mi.studio.synth.shapes import ball


@pytest.mark.slow
def test_load_tracks__visible_points_have_the_depth_of_the_view(clip: Path) -> None:
    """Visible points lie on the surface of their pixel, up to its slope; hidden ones behind it or
    outside.
    """
    tracks = load_tracks(clip / "truth")
    compared = np.zeros(2, int)
    cameras = load_capture(clip).cameras
    assert list(tracks.visible) == [camera.name for camera in cameras]
    for camera in cameras:
        for frame in range(3):
            truth = load_truth(clip / "truth", camera.name, frame)
            pixels, depth = camera.project(tracks.points[:, frame])
            in_image = ((pixels >= 0) & (pixels < (64, 48))).all(-1)
            mask = tracks.visible[camera.name][:, frame]
            assert not (mask & ~in_image).any()
            column, row = np.floor(pixels[in_image]).astype(int).T
            ahead = depth[in_image] / truth.depth[row, column] - 1
            assert np.mean(np.abs(ahead[mask[in_image]]) < 0.03) > 0.95
            assert np.median(ahead[~mask[in_image]]) > 0.01
            compared += mask.sum(), (in_image & ~mask).sum()
    assert (compared > (5000, 500)).all(), compared


@pytest.mark.slow
def test_load_tracks__every_point_is_visible_where_it_was_sampled(clip: Path) -> None:
    visible = np.stack(list(load_tracks(clip / "truth").visible.values()))
    assert visible.any((0, 2)).all()


@pytest.mark.parametrize(("x", "expected"), [(0.0, [False, True]), (1.0, [True, True])])
def test_sees__a_ball_hides_what_is_behind_it(x: float, expected: list[bool]) -> None:
    """Of two points on the axis, the ball at the origin hides the farther one, unless it is moved
    aside.
    """
    grey = {"type": "diffuse"}
    front = Object({"ball": ball(0.2, grey)}, lambda time: translate(x, 0, 0))
    back = Object({"ball": ball(0.1, grey, (0, 0, -1))})
    tracer = PathTracer(Scene("two balls", {"front": front, "back": back}, {}))
    camera = tracer.scene.rig.cameras(2, 64, 48)[0]
    camera = type(camera).look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40, 64, 48)
    points = np.array([(0, 0, -0.9), (x, 0, 0.2)])
    assert tracer.sees(camera, points).tolist() == expected
    assert not tracer.sees(camera, np.array([(0, 0, 4.5), (9, 0, 0)])).any(), (
        "behind the camera and outside its image"
    )


def test_save_tracks__load_tracks_reads_them_back(tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(2, 2, 3)
    ids = np.array([1, 2], np.int32)
    for visible in ({}, {"cam00": np.array([[True, False], [False, False]])}):
        save_tracks(tmp_path, Tracks(points, ids, visible))
        tracks_of_file = load_tracks(tmp_path)
        assert (tracks_of_file.points.tolist(), tracks_of_file.ids.tolist()) == (
            points.tolist(),
            ids.tolist(),
        )
        assert {name: mask.tolist() for name, mask in tracks_of_file.visible.items()} == {
            n: m.tolist() for n, m in visible.items()
        }
