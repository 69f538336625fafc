"""The reprojection check, triangulation and the picture of the rig, on textured planes seen from known cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.calibration.rig_check import MAX_ERROR, Common, check_rig, match_capture, triangulate_points
from morgs_mi.calibration.rig_plot import draw_rig
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.features import detect, match_views, reprojection_errors, triangulate
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.poses_bounds import read_poses_bounds, write_poses_bounds
from morgs_mi.capture.lens import Lens, undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video
from tests.capture import textured

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Six off-centre cameras without points, and their first frame."""
    path = tmp_path_factory.mktemp("rig")
    cameras, planes = textured.rig(shift=7), textured.textures()
    write_colmap(path / "sparse", cameras)
    for camera in cameras:
        write_video(path / f"{camera.name}.mkv", [textured.render(camera, planes)], 30)
    return load_capture(path)


@pytest.fixture(scope="module")
def common(capture: Capture) -> Common:
    return match_capture(capture)


def with_cameras(capture: Capture, change: Callable[[int, Camera], Camera]) -> Capture:
    return replace(capture, cameras=tuple(change(i, camera) for i, camera in enumerate(capture.cameras)))


def test_true_poses_fit(capture: Capture, common: Common) -> None:
    check = check_rig(capture, common)
    assert check.fits
    assert check.advice == "the poses fit the pictures."
    assert check.pairs == 15
    assert check.matches > 3000
    assert check.camera_matches.sum() == 2 * check.matches
    # The pictures are exact; SIFT places its features to some hundredths of a pixel.
    assert check.error < 0.05
    assert check.camera_errors.max() < 0.1


def test_the_error_is_that_of_the_points_projections(capture: Capture, common: Common) -> None:
    """Against the distance to epipolar lines: no point can be nearer to both features than half of that."""
    moved = with_cameras(capture, lambda i, c: turned(c, 4) if i == 2 else c).cameras
    match = next(m for m in common.matches if m.views == (1, 2))
    errors = reprojection_errors(match, common.features, moved)
    a, b = (moved[v] for v in match.views)
    relative = b.viewmat @ np.linalg.inv(a.viewmat)
    x, y, z = relative[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    F = np.linalg.inv(b.K).T @ E @ np.linalg.inv(a.K)
    left, right = (
        np.column_stack([common.features[v].points[match.features[:, k]], np.ones(len(errors))])
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
    """Turn a camera about its own optical axis."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return replace(camera, viewmat=np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ camera.viewmat)


TO_WORLD, TO_CAMERA = "camera to world", "world to camera"
POSES = {
    (TO_CAMERA, "OpenCV"): lambda c: c.viewmat,
    (TO_CAMERA, "OpenGL"): lambda c: FLIP @ c.viewmat,
    (TO_WORLD, "OpenCV"): lambda c: np.linalg.inv(c.viewmat),
    (TO_WORLD, "OpenGL"): lambda c: np.linalg.inv(FLIP @ c.viewmat),
}


@pytest.mark.parametrize("kind", list(POSES), ids=" ".join)
@pytest.mark.parametrize("layout", ["COLMAP", "Nerfstudio"])
def test_poses_of_another_kind_are_named(capture: Capture, common: Common, layout: str, kind: tuple[str, str]) -> None:
    """The four kinds of poses, each given where the layout expects one of them."""
    given = [POSES[kind](camera) for camera in capture.cameras]
    if layout == "Nerfstudio":  # as `read_transforms` takes them
        given = [np.linalg.inv(pose @ FLIP) for pose in given]
    read = with_cameras(replace(capture, layout=layout), lambda i, c: replace(c, viewmat=given[i]))
    check = check_rig(read, common)
    expected = {"COLMAP": (TO_CAMERA, "OpenCV"), "Nerfstudio": (TO_WORLD, "OpenGL")}[layout]
    assert check.fits is (kind == expected)
    if not check.fits:
        assert check.error > MAX_ERROR
        assert f"do not fit the pictures: the poses seem to be {kind[0]} in {kind[1]}'s" in check.advice
        assert f"expected {expected[0]} in {expected[1]}'s" in check.advice


def test_a_single_wrong_camera_is_named(capture: Capture, common: Common) -> None:
    check = check_rig(with_cameras(capture, lambda i, c: turned(c, 5) if i == 3 else c), common)
    assert check.fits is False
    assert "the poses of cam3 do not fit the pictures: check the order" in check.advice
    assert int(np.argmax(check.camera_errors)) == 3


def test_rows_in_alphabetical_order_are_named(tmp_path: Path) -> None:
    """Meet Room's names have no leading zeros: cam_10 comes before cam_2 in the alphabet, after it by number."""
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


def test_columns_of_another_convention_are_named(tmp_path: Path, capture: Capture, common: Common) -> None:
    cameras = [Camera(textured.rig()[i].K, c.viewmat, c.width, c.height, c.name) for i, c in enumerate(capture.cameras)]
    write_poses_bounds(tmp_path / "p.npy", cameras, [[1, 9]] * 6)
    rows = np.load(tmp_path / "p.npy")
    matrices = rows[:, :15].reshape(6, 3, 5)
    down, right = matrices[..., 0].copy(), matrices[..., 1].copy()
    matrices[..., 0], matrices[..., 1] = right, -down
    np.save(tmp_path / "p.npy", rows)
    read, _ = read_poses_bounds(tmp_path / "p.npy", capture.names)
    # The principal points of the pictures, which the format cannot hold.
    read = tuple(replace(c, K=own.K) for c, own in zip(read, capture.cameras, strict=True))
    check = check_rig(replace(capture, cameras=read, layout="poses_bounds"), common)
    assert check.fits is False
    assert "the columns seem to be the camera's right, up and backward axes" in check.advice


def test_too_few_matches_are_no_verdict(capture: Capture) -> None:
    blank = detect(np.full((48, 64, 3), 128, np.uint8))
    assert blank.points.shape == (0, 2)
    check = check_rig(capture, Common((blank,) * 6, tuple(match_views([blank] * 6, capture.cameras))))
    assert check.fits is None
    assert check.matches == 0
    assert np.isnan(check.error)
    assert "too few matches" in check.advice


def test_fewer_than_fifty_matches_are_no_verdict_even_if_they_fit(capture: Capture, common: Common) -> None:
    first = common.matches[0]
    for count, fits in ((49, None), (50, True)):
        few = Common(common.features, (replace(first, features=first.features[:count]),))
        assert check_rig(capture, few).fits is fits
    assert "no match with cam2, cam3, cam4, cam5" in check_rig(capture, few).advice


def test_what_the_check_hardly_sees(capture: Capture, common: Common) -> None:
    """The price of trusting two views at a time: all principal points off by 5 px still fit."""
    shift = np.array([[0, 0, 5], [0, 0, 5], [0, 0, 0]])
    check = check_rig(with_cameras(capture, lambda i, c: replace(c, K=c.K + shift)), common)
    assert check.fits
    assert check.error > 3 * check_rig(capture, common).error


def test_features_lie_where_the_picture_says() -> None:
    """A blob at a known place, at several sizes of the image: pixel centres lie at +0.5."""
    for width, height in ((160, 120), (1600, 1200)):
        scale = width / 160
        u, v = 70.3 * scale, 52.6 * scale
        y, x = np.mgrid[:height, :width] + 0.5
        blob = 120 + 120 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * (4 * scale) ** 2))
        found = detect(np.repeat(blob[..., None], 3, -1).astype(np.uint8)).points
        nearest = found[np.argmin(np.linalg.norm(found - (u, v), axis=1))]
        np.testing.assert_allclose(nearest, (u, v), atol=0.1 * scale)


def test_features_keep_out_of_what_was_not_recorded(capture: Capture) -> None:
    image = next(capture.frames()).images[0]
    mask = np.zeros(image.shape[:2], bool)
    mask[:, 160:] = True
    assert detect(image, mask).points[:, 0].min() > 158


def test_points_are_triangulated_on_the_planes(capture: Capture, common: Common) -> None:
    points, colors = triangulate(common.matches, common.features, capture.cameras)
    assert points.dtype == colors.dtype == np.float32
    assert len(points) > 1000
    # 0.1 px at 4 units, 277 px focal length and a base of 0.5 is 1 cm; occlusion edges make a few wrong.
    distance = textured.distance_to_planes(points)
    assert np.percentile(distance, 90) < 0.05
    assert np.percentile(distance, 98) < 0.3
    # Their colours are those of the pixels that they project to.
    camera, image = capture.cameras[2], next(capture.frames()).images[2]
    x = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    u, v = (x[:, :2] / x[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]).astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (x[:, 2] > 0)
    assert np.median(np.abs(image[v[inside], u[inside]] / 255 - colors[inside])) < 0.05


def test_points_under_a_small_angle_are_left_out(capture: Capture, common: Common) -> None:
    counts = [
        len(triangulate(common.matches, common.features, capture.cameras, min_angle=angle)[0]) for angle in (1, 20, 60)
    ]
    assert counts[0] > counts[1] > counts[2] == 0


def test_points_of_a_capture_leave_the_held_out_view_alone(capture: Capture, common: Common) -> None:
    found = triangulate_points(capture, common)
    assert len(found.points) == len(found.point_colors) > 1000
    held_out = replace(capture, test_view=3)
    fewer = triangulate_points(held_out, common)
    blind = Common(
        tuple(detect(np.zeros((48, 64, 3), np.uint8)) if i == 3 else f for i, f in enumerate(common.features)),
        tuple(match for match in common.matches if 3 not in match.views),
    )
    np.testing.assert_array_equal(fewer.points, triangulate_points(held_out, blind).points)
    assert len(fewer.points) < len(found.points)
    wrong = with_cameras(capture, lambda i, c: replace(c, viewmat=FLIP @ c.viewmat))
    assert len(triangulate_points(wrong, common).points) == 0


def test_a_lens_that_is_undone_fits_and_one_that_is_ignored_does_not(tmp_path: Path) -> None:
    """The recorded picture is bent by OpenCV's own model; only reading the lens makes the poses fit."""
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


def test_info_prints_the_check_and_draws_the_rig(capture: Capture, tmp_path: Path, capsys) -> None:
    plot = tmp_path / "new" / "rig.png"
    before = {file: file.stat().st_mtime_ns for file in capture.path.rglob("*")}
    assert cli.main(["info", str(capture.path), "--plot", str(plot)]) == 0
    out = capsys.readouterr().out
    assert "COLMAP" in out
    assert "1 frames at 30 fps, without points (" in out
    assert "Reprojection check: median 0.0" in out
    assert "in 15 pairs; the poses fit the pictures." in out
    image = cv2.imread(str(plot))
    assert image.shape == (760, 1440, 3)
    assert {file: file.stat().st_mtime_ns for file in capture.path.rglob("*")} == before
    assert cli.main(["info", str(capture.path), "--no-check"]) == 0
    assert "Reprojection" not in capsys.readouterr().out
    assert cli.main(["info", str(capture.path), "--plot", str(tmp_path / "rig.pdf")]) == 1
    assert "must be called .png or .jpg, got '.pdf'" in capsys.readouterr().err


def test_the_rig_is_drawn_where_it_stands() -> None:
    """Cameras on a line: from above they lie side by side, the held-out one in red."""
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
    assert green[:, 0].mean() < rows.min()  # ahead of the cameras, which look to the top
    assert abs(green[:, 1].mean() - 360) < 2


@pytest.mark.parametrize("count", [1, 2, 8])
def test_any_rig_can_be_drawn(count: int) -> None:
    angles = 2 * np.pi * np.arange(count) / count
    cameras = [Camera.look_at((np.cos(a), np.sin(a), 0), (0, 0, 0), (0, 0, 1), 60, 64, 48, "c") for a in angles]
    image = draw_rig(cameras, np.zeros((0, 3)), np.zeros((0, 3)))
    assert (image < 200).any()
