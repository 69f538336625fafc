"""The mistakes that the reprojection check names, made one at a time in a rig with true poses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.features import match_views
from morgs_mi.capture.layouts import reader_registry
from morgs_mi.capture.layouts.calibration import PoseConvention
from morgs_mi.capture.layouts.poses_bounds import read_poses_bounds, write_poses_bounds
from morgs_mi.capture.points import MAX_ERROR, SharedFeatures, match_capture
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video
from morgs_mi.studio.calibration.checks.rig_check import check_rig
from tests.scenes import textured
from tests.scenes.textured import turned, with_cameras

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
TO_WORLD = "camera to world"
TO_CAMERA = "world to camera"
POSES = {
    (TO_CAMERA, "OpenCV"): lambda c: c.viewmat,
    (TO_CAMERA, "OpenGL"): lambda c: FLIP @ c.viewmat,
    (TO_WORLD, "OpenCV"): lambda c: np.linalg.inv(c.viewmat),
    (TO_WORLD, "OpenGL"): lambda c: np.linalg.inv(FLIP @ c.viewmat),
}
# Convention that a layout expects; the last two have no layout yet.
EXPECTED = {
    "COLMAP": (TO_CAMERA, "OpenCV"),
    "Nerfstudio": (TO_WORLD, "OpenGL"),
    "toy OpenCV": (TO_WORLD, "OpenCV"),
    "toy OpenGL": (TO_CAMERA, "OpenGL"),
}


def interpreted(matrix: np.ndarray, direction: str, axes: str) -> np.ndarray:
    """Return the view matrix of a pose matrix in a convention, as `read_transforms` does for
    Nerfstudio.
    """
    if direction == TO_WORLD:
        matrix = np.linalg.inv(matrix)
    return FLIP @ matrix if axes == "OpenGL" else matrix


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(POSES), ids=" ".join)
@pytest.mark.parametrize("layout", list(EXPECTED))
def test_check_rig__names_another_pose_convention(
    capture: Capture,
    shared: SharedFeatures,
    layout: str,
    kind: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each of the four conventions is read as the one that the layout expects."""
    expected = EXPECTED[layout]
    toy = replace(reader_registry.READERS[0], name=layout, poses=PoseConvention(*expected))
    if layout.startswith("toy"):
        monkeypatch.setattr(reader_registry, "READERS", (*reader_registry.READERS, toy))
    cameras = [interpreted(POSES[kind](camera), *expected) for camera in capture.cameras]
    read = with_cameras(
        replace(capture, layout=layout), lambda i, c: replace(c, viewmat=cameras[i])
    )
    check = check_rig(read, shared)
    assert check.fits is (kind == expected)
    if not check.fits:
        assert check.error > MAX_ERROR
        assert (
            f"do not fit the images: the poses seem to be {kind[0]} in {kind[1]}'s" in check.advice
        )
        assert f"expected {expected[0]} in {expected[1]}'s" in check.advice


# Changes of camera 3, and a part of the sentence about it.
WRONG_CAMERAS = {
    "turned": (
        lambda c: turned(c, 5),
        "no common mistake explains it: check its place in the order of the cameras",
    ),
    "upside down": (lambda c: turned(c, 180), "upside down relative to its pose"),
    "sideways": (lambda c: turned(c, -90), "turned by 90 degrees about the optical axis"),
    "backward": (
        lambda c: replace(c, viewmat=np.diag([-1.0, 1, -1, 1]) @ c.viewmat),
        "its pose looks backward",
    ),
    "other axes": (lambda c: replace(c, viewmat=FLIP @ c.viewmat), "its pose is in other axes"),
    "inverse": (lambda c: replace(c, viewmat=np.linalg.inv(c.viewmat)), "its pose is inverted"),
    "focal": (
        lambda c: replace(c, K=c.K @ np.diag([2.0, 2, 1])),
        "its focal length .* 0.5 times the given value fits",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", WRONG_CAMERAS)
def test_check_rig__names_a_single_wrong_camera(
    capture: Capture, shared: SharedFeatures, kind: str
) -> None:
    change, sentence = WRONG_CAMERAS[kind]
    check = check_rig(with_cameras(capture, lambda i, c: change(c) if i == 3 else c), shared)
    assert check.fits is False
    assert check.advice == "the poses of cam3 do not fit the images."
    assert [camera.verdict for camera in check.cameras] == [
        *3 * ["fits"],
        "does not fit",
        *2 * ["fits"],
    ]
    assert re.search(sentence, check.cameras[3].advice)
    assert max(camera.error for i, camera in enumerate(check.cameras) if i != 3) < 0.1, (
        "only its own matches are bad"
    )


@pytest.mark.slow
def test_check_rig__names_each_of_two_wrong_cameras(
    capture: Capture, shared: SharedFeatures
) -> None:
    changes = {1: WRONG_CAMERAS["upside down"][0], 4: WRONG_CAMERAS["focal"][0]}
    check = check_rig(
        with_cameras(capture, lambda i, c: changes[i](c) if i in changes else c), shared
    )
    assert [camera.fits for camera in check.cameras] == [True, False, True, True, False, True]
    assert "upside down" in check.cameras[1].advice
    assert "its focal length" in check.cameras[4].advice


def test_check_rig__names_a_common_factor_on_all_focal_lengths(
    capture: Capture, shared: SharedFeatures
) -> None:
    """Two views hardly determine a common focal length: the errors are below a pixel, but the right
    one has less.
    """
    check = check_rig(
        with_cameras(capture, lambda i, c: replace(c, K=c.K @ np.diag([2.0, 2, 1]))), shared
    )
    assert check.fits is False
    assert check.error < MAX_ERROR
    assert "the focal lengths of all cameras" in check.advice
    assert "0.5 times the given value fits" in check.advice


@pytest.mark.slow
def test_check_rig__names_cameras_with_one_pose(capture: Capture, shared: SharedFeatures) -> None:
    pose = capture.cameras[2].viewmat
    one = check_rig(
        with_cameras(capture, lambda i, c: replace(c, viewmat=pose) if i == 3 else c), shared
    )
    assert [camera.fits for camera in one.cameras] == [True, True, True, False, True, True]
    assert "it has the same pose as cam2" in one.cameras[3].advice
    every = check_rig(with_cameras(capture, lambda i, c: replace(c, viewmat=pose)), shared)
    assert not any(camera.fits for camera in every.cameras)
    assert all("it has the same pose as cam" in camera.advice for camera in every.cameras)


def with_images(shared: SharedFeatures, capture: Capture, order: tuple[int, ...]) -> SharedFeatures:
    """Return the features as if camera i had recorded the images of camera order[i]."""
    features = [shared.features[k] for k in order]
    return SharedFeatures(tuple(features), tuple(match_views(features, capture.cameras)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "wrong", "sentence"),
    [
        (
            (0, 3, 2, 1, 4, 5),
            {1, 3},
            "the clips of cam1 and cam3, or their poses, seem to be swapped",
        ),
        (
            (0, 3, 1, 2, 4, 5),
            {1, 2, 3},
            "in another order .cam1 has the pose of cam3, cam2 has the pose of cam1",
        ),
    ],
)
def test_check_rig__names_images_in_another_order(
    capture: Capture, shared: SharedFeatures, order: tuple[int, ...], wrong: set[int], sentence: str
) -> None:
    check = check_rig(capture, with_images(shared, capture, order))
    assert {i for i, camera in enumerate(check.cameras) if camera.fits is False} == wrong
    assert re.search(sentence, check.advice)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_check_rig__names_swapped_images_in_a_small_rig(
    capture: Capture, shared: SharedFeatures, count: int
) -> None:
    """One wrong pose out of a few spoils the matches of most cameras."""
    part = replace(capture, cameras=capture.cameras[:count])
    few = SharedFeatures(shared.features[:count], ())
    check = check_rig(part, with_images(few, part, (1, 0, 2, 3)[:count]))
    assert check.fits is False
    assert "the clips of cam0 and cam1, or their poses, seem to be swapped" in check.advice


@pytest.mark.slow
def test_check_rig__names_a_copied_clip(capture: Capture, shared: SharedFeatures) -> None:
    check = check_rig(capture, with_images(shared, capture, (0, 1, 2, 3, 3, 5)))
    assert [camera.fits for camera in check.cameras] == [True, True, True, True, False, True]
    assert "its clip is a copy of the clip of cam3" in check.cameras[4].advice


@pytest.mark.slow
def test_check_rig__names_rows_in_alphabetical_order(tmp_path: Path) -> None:
    """Meet Room's names have no leading zeros: alphabetically cam_10 precedes cam_2, numerically it
    follows.
    """
    names = ("cam_0", "cam_1", "cam_2", "cam_10")
    planes = textured.textures()
    cameras = dict(zip(names, textured.rig(4, 240, 180), strict=True))
    for name, camera in cameras.items():
        write_video(tmp_path / f"{name}.mkv", [textured.render(camera, planes)], 30)
    for order, fits in ((names, True), (sorted(names), False)):
        write_poses_bounds(
            tmp_path / "poses_bounds.npy", [cameras[name] for name in order], [[1, 9]] * 4
        )
        capture = load_capture(tmp_path)
        check = check_rig(capture, match_capture(capture))
        assert check.fits is fits
    assert (
        "the rows seem to be in alphabetical order (cam_0, cam_1, cam_10, cam_2, ...)"
        in check.advice
    )


@pytest.mark.slow
def test_check_rig__names_columns_of_another_convention(
    tmp_path: Path, capture: Capture, shared: SharedFeatures
) -> None:
    cameras = [
        Camera(textured.rig()[i].K, c.viewmat, c.width, c.height, c.name)
        for i, c in enumerate(capture.cameras)
    ]
    write_poses_bounds(tmp_path / "p.npy", cameras, [[1, 9]] * 6)
    rows = np.load(tmp_path / "p.npy")
    matrices = rows[:, :15].reshape(6, 3, 5)
    down = matrices[..., 0].copy()
    right = matrices[..., 1].copy()
    matrices[..., 0] = right
    matrices[..., 1] = -down
    np.save(tmp_path / "p.npy", rows)
    read, _ = read_poses_bounds(tmp_path / "p.npy", capture.names)
    # The principal points of the images, which the format cannot represent.
    read = tuple(replace(c, K=camera.K) for c, camera in zip(read, capture.cameras, strict=True))
    check = check_rig(replace(capture, cameras=read, layout="poses_bounds"), shared)
    assert check.fits is False
    assert "the columns seem to be the camera's right, up and backward axes" in check.advice
