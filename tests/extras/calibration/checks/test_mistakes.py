"""The mistakes that the reprojection check names, made one at a time in a rig with true poses."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.view import Views
from morgs_mi.extras.calibration.checks.rig_check import check_rig
from morgs_mi.fit.features import match_views
from morgs_mi.fit.image_points import MAX_ERROR
from tests.scenes.textured import turned, with_cameras

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def with_poses(capture, change):
    """Return the capture with a change of all view matrices."""
    return with_cameras(capture, lambda _, c: replace(c, viewmat=change(c.viewmat)))


def fits(check):
    return [camera.fits for camera in check.cameras]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layout", "change", "sentence"),
    [
        ("COLMAP", lambda V: FLIP @ V, "world to camera in OpenGL's"),
        ("COLMAP", np.linalg.inv, "camera to world in OpenCV's"),
        ("COLMAP", lambda V: np.linalg.inv(FLIP @ V), "camera to world in OpenGL's"),
        ("Nerfstudio", lambda V: FLIP @ V, "camera to world in OpenCV's"),
        ("Nerfstudio", lambda V: FLIP @ np.linalg.inv(V), "world to camera in OpenCV's"),
        ("Nerfstudio", lambda V: FLIP @ np.linalg.inv(FLIP @ V), "world to camera in OpenGL's"),
    ],
)
def test_check_rig__names_another_pose_convention(capture, shared, layout, change, sentence):
    check = check_rig(replace(with_poses(capture, change), layout=layout), shared)
    assert check.fits is False
    assert check.error > MAX_ERROR
    assert f"do not fit the images: the poses seem to be {sentence}" in check.advice
    expected = "world to camera in OpenCV" if layout == "COLMAP" else "camera to world in OpenGL"
    assert f"expected {expected}'s" in check.advice


def with_wrong_focal_length(camera):
    return replace(camera, K=camera.K @ np.diag([2.0, 2, 1]))


# Changes of camera 3.
WRONG_CAMERAS = {
    "turned": lambda c: turned(c, 5),
    "upside down": lambda c: turned(c, 180),
    "sideways": lambda c: turned(c, -90),
    "other axes": lambda c: replace(c, viewmat=FLIP @ c.viewmat),
    "inverse": lambda c: replace(c, viewmat=np.linalg.inv(c.viewmat)),
    "focal": with_wrong_focal_length,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", WRONG_CAMERAS)
def test_check_rig__names_a_single_wrong_camera(capture, shared, kind):
    change = WRONG_CAMERAS[kind]
    check = check_rig(with_cameras(capture, lambda i, c: change(c) if i == 3 else c), shared)
    assert check.advice == "the poses of cam3 do not fit the images."
    assert fits(check) == [True, True, True, False, True, True]
    assert check.cameras[3].advice.startswith("check its place in the order of the cameras")
    errors = [camera.error for camera in check.cameras]
    assert max(errors[:3] + errors[4:]) < 0.1, "only its own matches are bad"


@pytest.mark.slow
def test_check_rig__names_each_of_two_wrong_cameras(capture, shared):
    changes = {1: WRONG_CAMERAS["upside down"], 4: WRONG_CAMERAS["focal"]}
    check = check_rig(
        with_cameras(capture, lambda i, c: changes[i](c) if i in changes else c), shared
    )
    assert fits(check) == [True, False, True, True, False, True]


def test_check_rig__names_a_common_factor_on_all_focal_lengths(capture, shared):
    """Two views hardly determine a common focal length: the errors are below a pixel, but the right
    one has less.
    """
    check = check_rig(with_cameras(capture, lambda _, c: with_wrong_focal_length(c)), shared)
    assert check.fits is False
    assert check.error < MAX_ERROR
    assert "the focal lengths of all cameras" in check.advice
    assert "0.5 times the given value fits" in check.advice


@pytest.mark.slow
def test_check_rig__refuses_cameras_with_one_pose(capture, shared):
    pose = capture.cameras[2].viewmat
    one = check_rig(
        with_cameras(capture, lambda i, c: replace(c, viewmat=pose) if i == 3 else c), shared
    )
    assert fits(one) == [True, True, True, False, True, True]
    every = check_rig(with_poses(capture, lambda _: pose), shared)
    assert not any(fits(every))


def with_images(shared, capture, order):
    """Return the features as if camera i had recorded the images of camera order[i]."""
    features = [shared.features[k] for k in order]
    return match_views(features, capture.cameras)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "wrong", "sentence"),
    [
        ((0, 3, 2, 1, 4, 5), {1, 3}, "clips of cam1 and cam3, or their poses, seem to be swapped"),
        (
            (0, 3, 1, 2, 4, 5),
            {1, 2, 3},
            "the poses of cam1, cam2, cam3 do not fit the images",  # two at a time explain nothing
        ),
    ],
)
def test_check_rig__names_images_in_another_order(capture, shared, order, wrong, sentence):
    check = check_rig(capture, with_images(shared, capture, order))
    assert {i for i, fit in enumerate(fits(check)) if fit is False} == wrong
    assert sentence in check.advice


@pytest.mark.parametrize("count", [2, 4])
def test_check_rig__names_swapped_images_in_a_small_rig(capture, shared, count):
    """One wrong pose out of a few spoils the matches of most cameras."""
    part = replace(capture, views=Views(capture.views[:count]))
    check = check_rig(part, with_images(shared, part, (1, 0, 2, 3)[:count]))
    assert check.fits is False
    assert "the clips of cam0 and cam1, or their poses, seem to be swapped" in check.advice


@pytest.mark.slow
def test_check_rig__refuses_a_copied_clip(capture, shared):
    check = check_rig(capture, with_images(shared, capture, (0, 1, 2, 3, 3, 5)))
    assert fits(check) == [True, True, True, True, False, True]


@pytest.mark.slow
def test_check_rig__names_rows_in_alphabetical_order(capture, shared):
    """Meet Room's names have no leading zeros: alphabetically cam_10 precedes cam_2, numerically it
    follows.
    """
    names = ["cam_0", "cam_1", "cam_2", "cam_10", "cam_11", "cam_12"]
    right = with_cameras(capture, lambda i, c: replace(c, name=names[i]))
    right = replace(right, layout="poses_bounds")
    assert check_rig(right, shared).fits
    # Row i, which belongs to the camera of the i-th name in alphabetical order.
    rows = [right.cameras[names.index(name)].viewmat for name in sorted(names)]
    check = check_rig(with_cameras(right, lambda i, c: replace(c, viewmat=rows[i])), shared)
    assert "rows seem to be in alphabetical order (cam_0, cam_1, cam_10, cam_11" in check.advice


@pytest.mark.slow
def test_check_rig__names_columns_of_another_convention(capture, shared):
    wrong = with_cameras(capture, lambda _, c: turned(c, 90))
    check = check_rig(replace(wrong, layout="poses_bounds"), shared)
    assert check.fits is False
    assert "the columns seem to be the camera's right, up and backward axes" in check.advice
