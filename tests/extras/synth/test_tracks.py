"""Tracks: visibility against a known occluder, and their file."""

import numpy as np
import pytest
from numpy.testing import assert_equal

from morgs_mi import Camera
from morgs_mi.capture.truth import Tracks, load_tracks, save_tracks
from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import Object, Scene, translate
from morgs_mi.extras.synth.shapes import ball


@pytest.mark.parametrize(("x", "expected"), [(0.0, [False, True]), (1.0, [True, True])])
def test_sees__a_ball_hides_what_is_behind_it(x, expected):
    """Of two points on the axis, the ball at the origin hides the farther one, unless it is moved
    aside. Points behind the camera and outside its image are not seen.
    """
    grey = {"type": "diffuse"}
    front = Object({"ball": ball(0.2, grey)}, lambda time: translate(x, 0, 0))
    back = Object({"ball": ball(0.1, grey, (0, 0, -1))})
    tracer = PathTracer(Scene("two balls", {"front": front, "back": back}, {}))
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40, 64, 48)
    points = np.array([(0, 0, -0.9), (x, 0, 0.2), (0, 0, 4.5), (9, 0, 0)])
    assert tracer.sees(camera, points).tolist() == [*expected, False, False]


@pytest.mark.parametrize("visible", [{}, {"cam00": np.array([[True, False], [False, False]])}])
def test_save_tracks__load_tracks_reads_them_back(tmp_path, visible):
    tracks = Tracks(np.arange(12.0).reshape(2, 2, 3), np.array([1, 2], np.int32), visible)
    save_tracks(tmp_path, tracks)
    assert_equal(vars(load_tracks(tmp_path)), vars(tracks))
