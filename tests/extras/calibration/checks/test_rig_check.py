"""The reprojection check and triangulation on textured planes seen from known cameras."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.points import match_capture, triangulate_points
from morgs_mi.core.view import View, Views
from morgs_mi.extras.calibration.checks.rig_check import check_rig, pose_problems
from morgs_mi.fit.features import SharedFeatures, detect
from morgs_mi.loop.first_frame import fit_gaussians
from morgs_mi.stream_loop import StreamLoop
from tests.quick import quick
from tests.scenes import textured
from tests.scenes.textured import turned, with_cameras

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.slow
def test_check_rig__accepts_true_poses(capture, shared):
    check = check_rig(capture, shared)
    assert check.fits
    assert check.advice == "the poses fit the images."
    assert check.pairs == 15
    assert check.matches > 3000
    assert sum(camera.matches for camera in check.cameras) == 2 * check.matches
    # The images are exact; SIFT locates features to some hundredths of a pixel.
    assert check.error < 0.05
    assert max(camera.error for camera in check.cameras) < 0.1
    assert [(camera.verdict, camera.advice) for camera in check.cameras] == 6 * [("fits", "")]


def test_check_rig__does_not_check_a_camera_without_matches(capture, shared):
    others = tuple(match for match in shared.matches if 3 not in match.views)
    check = check_rig(capture, SharedFeatures(shared.features, others))
    assert check.fits is None
    assert check.advice == "the poses of cam3 could not be checked."
    assert (check.cameras[3].fits, check.cameras[3].matches) == (None, 0)
    assert np.isnan(check.cameras[3].error)
    assert (
        "no matches with any other camera: check that the clip is of this scene"
        in check.cameras[3].advice
    )


def test_check_rig__names_a_first_image_that_is_black(capture, shared):
    features = tuple(f if v != 3 else detect(None) for v, f in enumerate(shared.features))
    others = tuple(match for match in shared.matches if 3 not in match.views)
    check = check_rig(capture, SharedFeatures(features, others)).cameras[3]
    assert check.fits is None
    assert check.advice.startswith("its first image is black, of one colour or missing: cut such")


def test_check_rig__does_not_check_a_camera_that_matches_only_a_wrong_one(capture, shared):
    some = tuple(match for match in shared.matches if 5 not in match.views or match.views == (4, 5))
    wrong = with_cameras(capture, lambda i, c: turned(c, 20) if i == 4 else c)
    check = check_rig(wrong, SharedFeatures(shared.features, some))
    assert [camera.fits for camera in check.cameras] == [*4 * [True], False, None]
    assert "matches only with cameras that do not fit" in check.cameras[5].advice


def test_check_rig__is_undecided_with_fewer_than_fifty_matches(capture, shared):
    first = shared.matches[0]
    for count, fits in ((49, None), (50, True)):
        few = SharedFeatures(shared.features, (replace(first, features=first.features[:count]),))
        check = check_rig(capture, few)
        assert [check.cameras[view].fits for view in first.views] == [fits, fits]
    assert check.advice == "the poses of cam2, cam3, cam4, cam5 could not be checked."


def test_triangulate_points__ignores_the_held_out_view(capture, shared):
    points = triangulate_points(capture, shared)
    assert len(points.points) == len(points.point_colors) > 1000
    held_out = capture.holding_out(3)
    fewer = triangulate_points(held_out, shared)
    features = list(shared.features)
    features[3] = detect(None)
    others = tuple(match for match in shared.matches if 3 not in match.views)
    blind = SharedFeatures(tuple(features), others)
    assert_array_equal(fewer.points, triangulate_points(held_out, blind).points)
    assert len(fewer.points) < len(points.points)
    wrong = with_cameras(capture, lambda _, c: replace(c, viewmat=FLIP @ c.viewmat))
    assert len(triangulate_points(wrong, shared).points) == 0


@pytest.mark.slow
def test_match_capture__finds_features_at_the_recorded_size(capture, shared):
    small = load_capture(capture.path, 4)
    matches = match_capture(small)
    assert [len(f.points) for f in matches.features] == [len(f.points) for f in shared.features]
    assert check_rig(small, matches).error == pytest.approx(
        check_rig(capture, shared).error, abs=0.01
    )
    points = triangulate_points(small, matches).points
    count = len(triangulate_points(capture, shared).points)
    assert len(points) == pytest.approx(count, rel=0.01)


def test_triangulate_points__matches_distant_views_with_their_poses(capture, shared):
    ends = replace(capture, views=Views((capture.views[0], capture.views[5]))).holding_out(None)
    unmatched = SharedFeatures((shared.features[0], shared.features[5]), ())
    points = triangulate_points(ends, unmatched)
    assert len(points.points) > 50
    wrong = with_cameras(ends, lambda i, c: replace(c, viewmat=FLIP @ c.viewmat) if i else c)
    assert len(triangulate_points(wrong, unmatched).points) < 0.2 * len(points.points)


SWAPPED = "the clips of view 1 and view 2, or their poses, seem to be swapped; exchange them"


@pytest.mark.parametrize(
    ("width", "order", "sentence"),
    [
        (96, (0, 1, 2, 3), None),
        (48, (0, 1, 2, 3), None),
        (96, (0, 2, 1, 3), SWAPPED),
        (96, (3, 2, 1, 0), "the poses of view 0, view 1, view 2, view 3 do not fit the images"),
        (320, (3, 0, 2, 1), "the poses of view 0, view 1, view 2, view 3 do not fit the images"),
        (48, (1, 3, 0, 2), None),  # an exchange of two explains the few matches by chance
    ],
)
def test_pose_problems__name_the_right_order_or_none(width, order, sentence):
    cameras = [replace(camera, name="") for camera in textured.rig(4, width, 3 * width // 4)]
    planes = textured.textures()
    images = [textured.render(camera, planes) for camera in cameras]
    views = [View(camera, images[k]) for camera, k in zip(cameras, order, strict=True)]
    problems = pose_problems(views)
    assert len(problems) == (sentence is not None)
    for problem in problems:
        assert sentence in problem
        assert problem.endswith("; a list of images has the cameras' order, a dict their names.")


def test_fit_gaussians__warns_of_images_in_another_order(caplog):
    cameras = [replace(camera, name=f"cam{i}") for i, camera in enumerate(textured.rig(4, 96, 72))]
    planes = textured.textures()
    a, b, c, d = (textured.render(camera, planes) for camera in cameras)
    points = textured.points(np.random.default_rng(0), 50)
    named = dict(zip(("cam0", "cam2", "cam1", "cam3"), (a, c, b, d), strict=True))
    for images, is_warned in (([a, b, c, d], False), ([a, c, b, d], True), (named, False)):
        caplog.clear()
        fit_gaussians(cameras, images, *points, quick())
        StreamLoop(cameras, *points, quick()).push(images)
        messages = [record.getMessage() for record in caplog.records]
        assert sum("the poses do not fit the images" in text for text in messages) == 2 * is_warned
