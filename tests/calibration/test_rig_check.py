"""The reprojection check, triangulation and the plot of the rig, on textured planes seen from known cameras."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.calibration.rig_check import MAX_ERROR, SharedFeatures, check_rig, match_capture, triangulate_points
from morgs_mi.calibration.rig_plot import draw_rig
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.features import detect, match_views, reprojection_errors, triangulate
from morgs_mi.capture.layouts import registry
from morgs_mi.capture.layouts.calibration import PoseConvention
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.poses_bounds import read_poses_bounds, write_poses_bounds
from morgs_mi.capture.lens import Lens, undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video
from tests.assertions import assert_close
from tests.scenes import textured
from tests.scenes.cameras import circle, look_at_cameras

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Six cameras with off-centre principal points and one frame, without points."""
    path = tmp_path_factory.mktemp("rig")
    cameras, planes = textured.rig(shift=7), textured.textures()
    write_colmap(path / "sparse", cameras)
    for camera in cameras:
        write_video(path / f"{camera.name}.mkv", [textured.render(camera, planes)], 30)
    return load_capture(path)


@pytest.fixture(scope="module")
def shared(capture: Capture) -> SharedFeatures:
    return match_capture(capture)


def with_cameras(capture: Capture, change: Callable[[int, Camera], Camera]) -> Capture:
    return replace(capture, cameras=tuple(change(i, camera) for i, camera in enumerate(capture.cameras)))


def test_check_rig__accepts_true_poses(capture: Capture, shared: SharedFeatures) -> None:
    check = check_rig(capture, shared)
    assert check.fits
    assert check.advice == "the poses fit the images."
    assert check.pairs == 15
    assert check.matches > 3000
    assert sum(camera.matches for camera in check.cameras) == 2 * check.matches
    # The images are exact; SIFT locates features to some hundredths of a pixel.
    assert check.error < 0.05
    assert max(camera.error for camera in check.cameras) < 0.1
    assert [camera.verdict for camera in check.cameras] == 6 * ["fits"]
    assert not any(camera.advice for camera in check.cameras)


def test_reprojection_errors__are_bounded_by_epipolar_distances(capture: Capture, shared: SharedFeatures) -> None:
    """No point can be nearer to both features than half their distance to the epipolar lines."""
    moved = with_cameras(capture, lambda i, c: turned(c, 4) if i == 2 else c).cameras
    match = next(m for m in shared.matches if m.views == (1, 2))
    errors = reprojection_errors(match, shared.features, moved)
    a, b = (moved[v] for v in match.views)
    relative = b.viewmat @ np.linalg.inv(a.viewmat)
    x, y, z = relative[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    F = np.linalg.inv(b.K).T @ E @ np.linalg.inv(a.K)
    left, right = (
        np.column_stack([shared.features[v].points[match.features[:, k]], np.ones(len(errors))])
        for k, v in enumerate(match.views)
    )
    lines = left @ F.T
    distance = np.abs((lines * right).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    back = right @ F
    other = np.abs((back * left).sum(1)) / np.linalg.norm(back[:, :2], axis=1)
    assert np.median(distance) > 1
    assert (errors >= 0.45 * np.minimum(distance, other) - 1e-6).all()
    assert (errors <= distance + other + 1e-6).mean() > 0.95


def turned(camera: Camera, degrees: float) -> Camera:
    """Return the camera rotated about its optical axis."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return replace(camera, viewmat=np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ camera.viewmat)


TO_WORLD, TO_CAMERA = "camera to world", "world to camera"
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
    """Return the view matrix of a pose matrix in a convention, as `read_transforms` does for Nerfstudio."""
    if direction == TO_WORLD:
        matrix = np.linalg.inv(matrix)
    return FLIP @ matrix if axes == "OpenGL" else matrix


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
    toy = replace(registry.LAYOUTS[0], name=layout, poses=PoseConvention(*expected))
    if layout.startswith("toy"):
        monkeypatch.setattr(registry, "LAYOUTS", (*registry.LAYOUTS, toy))
    given = [interpreted(POSES[kind](camera), *expected) for camera in capture.cameras]
    read = with_cameras(replace(capture, layout=layout), lambda i, c: replace(c, viewmat=given[i]))
    check = check_rig(read, shared)
    assert check.fits is (kind == expected)
    if not check.fits:
        assert check.error > MAX_ERROR
        assert f"do not fit the images: the poses seem to be {kind[0]} in {kind[1]}'s" in check.advice
        assert f"expected {expected[0]} in {expected[1]}'s" in check.advice


SCALE = np.diag([2.0, 2, 2, 1])
# Changes of camera 3, and a part of the sentence about it.
WRONG_CAMERAS = {
    "turned": (lambda c: turned(c, 5), "no common mistake explains it: check its place in the order of the cameras"),
    "upside down": (lambda c: turned(c, 180), "upside down relative to its pose"),
    "sideways": (lambda c: turned(c, -90), "turned by 90 degrees about the optical axis"),
    "backward": (lambda c: replace(c, viewmat=np.diag([-1.0, 1, -1, 1]) @ c.viewmat), "its pose looks backward"),
    "other axes": (lambda c: replace(c, viewmat=FLIP @ c.viewmat), "its pose is in other axes"),
    "inverse": (lambda c: replace(c, viewmat=np.linalg.inv(c.viewmat)), "its pose is inverted"),
    "focal": (lambda c: replace(c, K=c.K @ np.diag([2.0, 2, 1])), "its focal length .* 0.5 times the given value fits"),
    "scaled": (lambda c: replace(c, viewmat=SCALE @ c.viewmat), "no rotation and translation: .* undo any scaling"),
    "mirrored": (lambda c: replace(c, viewmat=np.diag([-1.0, 1, 1, 1]) @ c.viewmat), "no rotation and translation"),
}


@pytest.mark.parametrize("kind", WRONG_CAMERAS)
def test_check_rig__names_a_single_wrong_camera(capture: Capture, shared: SharedFeatures, kind: str) -> None:
    change, sentence = WRONG_CAMERAS[kind]
    check = check_rig(with_cameras(capture, lambda i, c: change(c) if i == 3 else c), shared)
    assert check.fits is False
    assert check.advice == "the poses of cam3 do not fit the images."
    assert [camera.verdict for camera in check.cameras] == [*3 * ["fits"], "does not fit", *2 * ["fits"]]
    assert re.search(sentence, check.cameras[3].advice)
    assert max(camera.error for i, camera in enumerate(check.cameras) if i != 3) < 0.1, "only its own matches are bad"


def test_check_rig__names_each_of_two_wrong_cameras(capture: Capture, shared: SharedFeatures) -> None:
    changes = {1: WRONG_CAMERAS["upside down"][0], 4: WRONG_CAMERAS["focal"][0]}
    check = check_rig(with_cameras(capture, lambda i, c: changes[i](c) if i in changes else c), shared)
    assert [camera.fits for camera in check.cameras] == [True, False, True, True, False, True]
    assert "upside down" in check.cameras[1].advice
    assert "its focal length" in check.cameras[4].advice


def test_check_rig__names_a_common_factor_on_all_focal_lengths(capture: Capture, shared: SharedFeatures) -> None:
    """Two views hardly determine a common focal length: the errors are below a pixel, but the right one has less."""
    check = check_rig(with_cameras(capture, lambda i, c: replace(c, K=c.K @ np.diag([2.0, 2, 1]))), shared)
    assert check.fits is False
    assert check.error < MAX_ERROR
    assert "the focal lengths of all cameras" in check.advice
    assert "0.5 times the given value fits" in check.advice


def test_check_rig__names_cameras_with_one_pose(capture: Capture, shared: SharedFeatures) -> None:
    pose = capture.cameras[2].viewmat
    one = check_rig(with_cameras(capture, lambda i, c: replace(c, viewmat=pose) if i == 3 else c), shared)
    assert [camera.fits for camera in one.cameras] == [True, True, True, False, True, True]
    assert "it has the same pose as cam2" in one.cameras[3].advice
    every = check_rig(with_cameras(capture, lambda i, c: replace(c, viewmat=pose)), shared)
    assert not any(camera.fits for camera in every.cameras)
    assert all("it has the same pose as cam" in camera.advice for camera in every.cameras)


def with_images(shared: SharedFeatures, capture: Capture, order: tuple[int, ...]) -> SharedFeatures:
    """Return the features as if camera i had recorded the images of camera order[i]."""
    features = [shared.features[k] for k in order]
    return SharedFeatures(tuple(features), tuple(match_views(features, capture.cameras)))


@pytest.mark.parametrize(
    ("order", "wrong", "sentence"),
    [
        ((0, 3, 2, 1, 4, 5), {1, 3}, "the clips of cam1 and cam3, or their poses, seem to be swapped"),
        ((0, 3, 1, 2, 4, 5), {1, 2, 3}, "in another order .cam1 has that of cam3, cam2 has that of cam1"),
    ],
)
def test_check_rig__names_images_in_another_order(
    capture: Capture, shared: SharedFeatures, order: tuple[int, ...], wrong: set[int], sentence: str
) -> None:
    check = check_rig(capture, with_images(shared, capture, order))
    assert {i for i, camera in enumerate(check.cameras) if camera.fits is False} == wrong
    assert re.search(sentence, check.advice)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_check_rig__names_swapped_images_in_a_small_rig(capture: Capture, shared: SharedFeatures, count: int) -> None:
    """One wrong pose out of a few spoils the matches of most cameras."""
    part = replace(capture, cameras=capture.cameras[:count])
    few = SharedFeatures(shared.features[:count], ())
    check = check_rig(part, with_images(few, part, (1, 0, 2, 3)[:count]))
    assert check.fits is False
    assert "the clips of cam0 and cam1, or their poses, seem to be swapped" in check.advice


def test_check_rig__names_a_copied_clip(capture: Capture, shared: SharedFeatures) -> None:
    check = check_rig(capture, with_images(shared, capture, (0, 1, 2, 3, 3, 5)))
    assert [camera.fits for camera in check.cameras] == [True, True, True, True, False, True]
    assert "its images are those of cam3" in check.cameras[4].advice


def test_check_rig__does_not_check_a_camera_without_matches(capture: Capture, shared: SharedFeatures) -> None:
    others = tuple(match for match in shared.matches if 3 not in match.views)
    check = check_rig(capture, SharedFeatures(shared.features, others))
    assert check.fits is None
    assert check.advice == "the poses of 5 of 6 cameras fit the images; not checked: cam3."
    assert (check.cameras[3].fits, check.cameras[3].matches) == (None, 0)
    assert np.isnan(check.cameras[3].error)
    assert "no matches with any other camera: check that the clip is of this scene" in check.cameras[3].advice


def test_check_rig__does_not_check_a_camera_that_matches_only_a_wrong_one(
    capture: Capture, shared: SharedFeatures
) -> None:
    some = tuple(match for match in shared.matches if 5 not in match.views or match.views == (4, 5))
    wrong = with_cameras(capture, lambda i, c: turned(c, 20) if i == 4 else c)
    check = check_rig(wrong, SharedFeatures(shared.features, some))
    assert [camera.verdict for camera in check.cameras] == [*4 * ["fits"], "does not fit", "not checked"]
    assert "matches only with cameras that do not fit" in check.cameras[5].advice


def test_check_rig__names_rows_in_alphabetical_order(tmp_path: Path) -> None:
    """Meet Room's names have no leading zeros: alphabetically cam_10 precedes cam_2, numerically it follows."""
    names, planes = ("cam_0", "cam_1", "cam_2", "cam_10"), textured.textures()
    cameras = dict(zip(names, textured.rig(4, 240, 180), strict=True))
    for name, camera in cameras.items():
        write_video(tmp_path / f"{name}.mkv", [textured.render(camera, planes)], 30)
    for order, fits in ((names, True), (sorted(names), False)):
        write_poses_bounds(tmp_path / "poses_bounds.npy", [cameras[name] for name in order], [[1, 9]] * 4)
        capture = load_capture(tmp_path)
        check = check_rig(capture, match_capture(capture))
        assert check.fits is fits
    assert "the rows seem to be in alphabetical order (cam_0, cam_1, cam_10, cam_2, ...)" in check.advice


def test_check_rig__names_columns_of_another_convention(
    tmp_path: Path, capture: Capture, shared: SharedFeatures
) -> None:
    cameras = [Camera(textured.rig()[i].K, c.viewmat, c.width, c.height, c.name) for i, c in enumerate(capture.cameras)]
    write_poses_bounds(tmp_path / "p.npy", cameras, [[1, 9]] * 6)
    rows = np.load(tmp_path / "p.npy")
    matrices = rows[:, :15].reshape(6, 3, 5)
    down, right = matrices[..., 0].copy(), matrices[..., 1].copy()
    matrices[..., 0], matrices[..., 1] = right, -down
    np.save(tmp_path / "p.npy", rows)
    read, _ = read_poses_bounds(tmp_path / "p.npy", capture.names)
    # The principal points of the images, which the format cannot represent.
    read = tuple(replace(c, K=own.K) for c, own in zip(read, capture.cameras, strict=True))
    check = check_rig(replace(capture, cameras=read, layout="poses_bounds"), shared)
    assert check.fits is False
    assert "the columns seem to be the camera's right, up and backward axes" in check.advice


def test_check_rig__is_undecided_without_matches(capture: Capture) -> None:
    blank = detect(np.full((48, 64, 3), 128, np.uint8))
    assert blank.points.shape == (0, 2)
    check = check_rig(capture, SharedFeatures((blank,) * 6, tuple(match_views([blank] * 6, capture.cameras))))
    assert check.fits is None
    assert check.matches == 0
    assert np.isnan(check.error)
    assert "too few matches" in check.advice


def test_check_rig__is_undecided_with_fewer_than_fifty_matches(capture: Capture, shared: SharedFeatures) -> None:
    first = shared.matches[0]
    for count, fits in ((49, None), (50, True)):
        few = SharedFeatures(shared.features, (replace(first, features=first.features[:count]),))
        check = check_rig(capture, few)
        assert [check.cameras[view].fits for view in first.views] == [fits, fits]
    assert "the poses of 2 of 6 cameras fit the images; not checked: cam2, cam3" in check.advice


def test_check_rig__hardly_detects_a_common_shift_of_principal_points(capture: Capture, shared: SharedFeatures) -> None:
    """A limitation of comparing two views at a time: principal points that are all off by 5 px still fit."""
    shift = np.array([[0, 0, 5], [0, 0, 5], [0, 0, 0]])
    check = check_rig(with_cameras(capture, lambda i, c: replace(c, K=c.K + shift)), shared)
    assert check.fits
    assert check.error > 3 * check_rig(capture, shared).error


def test_detect__finds_a_blob_at_its_position() -> None:
    """A blob at a known position, at several image sizes: pixel centres lie at +0.5."""
    for width, height in ((160, 120), (1600, 1200)):
        scale = width / 160
        u, v = 70.3 * scale, 52.6 * scale
        y, x = np.mgrid[:height, :width] + 0.5
        blob = 120 + 120 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * (4 * scale) ** 2))
        found = detect(np.repeat(blob[..., None], 3, -1).astype(np.uint8)).points
        nearest = found[np.argmin(np.linalg.norm(found - (u, v), axis=1))]
        assert_close(nearest, (u, v), atol=0.1 * scale)


def test_detect__respects_the_mask(capture: Capture) -> None:
    image = next(capture.frames()).images[0]
    mask = np.zeros(image.shape[:2], bool)
    mask[:, 160:] = True
    assert detect(image, mask).points[:, 0].min() > 158


def test_triangulate__finds_points_on_the_planes(capture: Capture, shared: SharedFeatures) -> None:
    points, colors = triangulate(shared.matches, shared.features, capture.cameras)
    assert points.dtype == colors.dtype == np.float32
    assert len(points) > 1000
    # 0.1 px at 4 units, 277 px focal length and a base of 0.5 is 1 cm; a few points at occlusion edges are wrong.
    distance = textured.distance_to_planes(points)
    assert np.percentile(distance, 90) < 0.05
    assert np.percentile(distance, 98) < 0.3
    # Their colours are those of the pixels onto which they project.
    camera, image = capture.cameras[2], next(capture.frames()).images[2]
    pixels, depths = camera.project(points)
    u, v = pixels.astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (depths > 0)
    assert np.median(np.abs(image[v[inside], u[inside]] / 255 - colors[inside])) < 0.05


def test_triangulate__leaves_out_points_with_a_small_angle(capture: Capture, shared: SharedFeatures) -> None:
    counts = [
        len(triangulate(shared.matches, shared.features, capture.cameras, min_angle=angle)[0]) for angle in (1, 20, 60)
    ]
    assert counts[0] > counts[1] > counts[2] == 0


def test_triangulate_points__ignores_the_held_out_view(capture: Capture, shared: SharedFeatures) -> None:
    found = triangulate_points(capture, shared)
    assert len(found.points) == len(found.point_colors) > 1000
    held_out = replace(capture, test_view=3)
    fewer = triangulate_points(held_out, shared)
    blind = SharedFeatures(
        tuple(detect(np.zeros((48, 64, 3), np.uint8)) if i == 3 else f for i, f in enumerate(shared.features)),
        tuple(match for match in shared.matches if 3 not in match.views),
    )
    np.testing.assert_array_equal(fewer.points, triangulate_points(held_out, blind).points)
    assert len(fewer.points) < len(found.points)
    wrong = with_cameras(capture, lambda i, c: replace(c, viewmat=FLIP @ c.viewmat))
    assert len(triangulate_points(wrong, shared).points) == 0


def test_check_rig__fits_with_undistortion_only(tmp_path: Path) -> None:
    """The recorded images are distorted by OpenCV's own model; the poses fit only if the lens is read."""
    planes, k1 = textured.textures(), -0.25
    cameras = textured.rig(4)
    for camera in cameras:
        rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2)
        straight = (
            cv2.undistortPoints(pixels, K, np.array([k1, 0, 0, 0]), P=K).reshape(*rows.shape, 2).astype(np.float32)
        )
        image = cv2.remap(textured.render(camera, planes), straight[..., 0], straight[..., 1], cv2.INTER_CUBIC)
        write_video(tmp_path / f"{camera.name}.mkv", [image], 30)
    errors = []
    for lens in (Lens("SIMPLE_RADIAL", (k1,)), Lens()):
        write_colmap(tmp_path / "sparse", cameras, lenses=[lens] * 4)
        capture = load_capture(tmp_path)
        errors.append(check_rig(capture, match_capture(capture)).error)
    assert undistortion(cameras[0], Lens("SIMPLE_RADIAL", (k1,))) is not None
    assert errors[0] < 0.1
    assert errors[1] > 5 * errors[0]


def test_info_command__prints_complete_columns_and_a_verdict_per_camera(
    capture: Capture, tmp_path: Path, capsys
) -> None:
    path = tmp_path / ("capture of a rig in a folder with a long name" * 2)
    shutil.copytree(capture.path, path)
    grey = np.full((240, 320, 3), 128, np.uint8)
    write_video(path / "cam1.mkv", [grey], 30)
    write_video(path / "cam2.mkv", [next(capture.frames()).images[2][::-1, ::-1]], 30)
    assert cli.main(["info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "…" not in out
    rows = {line.split()[1]: line for line in out.splitlines() if re.match(r" [0-5]  cam", line)}
    assert re.search(r"train +0 +- +not checked", rows["cam1"])
    assert re.search(r"train +\d+ +\d+\.\d\d +does not fit", rows["cam2"])
    assert re.search(r"train +\d+ +0\.0\d +fits", rows["cam3"])
    assert "the poses of cam2 do not fit the images; not checked: cam1." in out
    assert "cam1 not checked: no matches with any other camera: check" in out
    assert "cam2 does not fit: its images are upside down" in out


def test_info_command__prints_the_check_and_draws_the_rig(capture: Capture, tmp_path: Path, capsys) -> None:
    plot = tmp_path / "new" / "rig.png"
    before = {file: file.stat().st_mtime_ns for file in capture.path.rglob("*")}
    assert cli.main(["info", str(capture.path), "--plot", str(plot)]) == 0
    out = capsys.readouterr().out
    assert "COLMAP" in out
    assert "1 frames at 30 fps, without points (" in out
    assert "Reprojection check: median 0.0" in out
    assert "in 15 pairs; the poses fit the images." in out
    image = cv2.imread(str(plot))
    assert image.shape == (760, 1440, 3)
    assert {file: file.stat().st_mtime_ns for file in capture.path.rglob("*")} == before
    assert cli.main(["info", str(capture.path), "--no-check"]) == 0
    assert "Reprojection" not in capsys.readouterr().out
    assert cli.main(["info", str(capture.path), "--plot", str(tmp_path / "rig.pdf")]) == 1
    assert "the suffix of a plot must be .png or .jpg, got '.pdf'" in capsys.readouterr().err


def test_draw_rig__draws_cameras_at_their_positions() -> None:
    """Cameras on a line lie side by side seen from above; the held-out one is red."""
    cameras = [Camera.look_at((x, 0, 0), (x, 0, 5), (0, -1, 0), 60, 64, 48, "") for x in (-1.0, 0.0, 1.0)]
    points = np.array([[0.0, 0, 3], [1e6, 0, 0]])
    image = draw_rig(cameras, points, np.array([[0, 1.0, 0], [0, 1, 0]]), test_view=1).astype(int)
    above = image[:, :720]
    rows, columns = np.nonzero((above[..., 0] == 210) & (above[..., 1] == 60))
    others = np.nonzero((above[..., 0] == 40) & (above[..., 1] == 90))[1]
    assert abs(columns.mean() - 360) < 2
    assert others.min() < 200
    assert others.max() > 520
    green = np.argwhere((above == (0, 255, 0)).all(-1))
    assert len(green)
    assert green[:, 0].mean() < rows.min()  # ahead of the cameras, which face the top
    assert abs(green[:, 1].mean() - 360) < 2


@pytest.mark.parametrize("count", [1, 2, 8])
def test_draw_rig__draws_any_rig(count: int) -> None:
    cameras = look_at_cameras(circle(2 * np.pi * np.arange(count) / count, z=0), 60, up=(0, 0, 1))
    image = draw_rig(cameras, np.zeros((0, 3)), np.zeros((0, 3)))
    assert (image < 200).any()
