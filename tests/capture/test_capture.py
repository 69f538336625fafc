"""Whole capture folders: layouts, order, downscaling, and broken ones."""

from __future__ import annotations

import json
import logging
import shutil
import weakref
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.poses_bounds import write_poses_bounds
from morgs_mi.capture.lens import Lens
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video
from morgs_mi.studio.calibration.calibrate import calibrate
from tests.assertions import assert_close
from tests.scenes import captures as layouts
from tests.scenes.captures import COUNT, FPS, HEIGHT, WIDTH, frames, make_camera, rig, videos


def n3dv(path: Path, names: tuple[str, ...] = ("cam00", "cam01", "cam02")) -> Path:
    videos(path, names, ".mp4")
    write_poses_bounds(path / "poses_bounds.npy", rig(names), [[1, 9]] * len(names))
    return path


def colmap(path: Path, names: tuple[str, ...] = ("cam01", "cam02"), **kwargs) -> Path:
    write_colmap(path / "sparse" / "0", rig(names, shift=3.0), **kwargs)
    videos(path, names, ".mp4")
    return path


def test_load_capture__reads_n3dv(tmp_path: Path) -> None:
    capture = load_capture(n3dv(tmp_path))
    assert capture.names == ("cam00", "cam01", "cam02")
    assert (capture.num_frames, capture.fps, capture.test_views, capture.truth) == (
        COUNT,
        FPS,
        (),
        None,
    )
    assert capture.points.shape == capture.point_colors.shape == (0, 3)
    assert capture.masks == (None,) * 3
    assert_close(capture.cameras[1].viewmat, make_camera(1, "cam01").viewmat, atol=1e-12)
    for t, frame in enumerate(capture.frames()):
        assert frame.index == t
        assert [tuple(image[5, 5]) for image in frame.images] == [(0, t, 0), (1, t, 0), (2, t, 0)]
    assert [f.index for f in capture.frames(1, 2)] == [1]


def test_frames__releases_the_images_of_past_frames(tmp_path: Path) -> None:
    """Memory does not grow with the length of a clip."""
    folder = n3dv(tmp_path)
    for i in range(3):
        write_video(folder / f"cam{i:02d}.mp4", frames(i, count=40), FPS)
    references = []
    for frame in load_capture(folder).frames():
        references.append(weakref.ref(frame.images[0]))
        del frame
        assert sum(reference() is not None for reference in references) <= 3
    assert len(references) == 40


def test_load_capture__prefers_the_colmap_model_and_orders_it_by_number(tmp_path: Path) -> None:
    points = np.arange(6.0).reshape(2, 3)
    names = ("cam10", "cam2", "cam1")  # a model lists its images in any order
    colmap(tmp_path, names, points=points, point_colors=points / 5)
    write_poses_bounds(
        tmp_path / "poses_bounds.npy", [make_camera(7, n) for n in names], [[1, 9]] * 3
    )
    capture = load_capture(tmp_path)
    assert capture.names == ("cam1", "cam2", "cam10")
    assert [image[0, 0, 0] for image in next(capture.frames()).images] == [2, 1, 0]
    assert_close(capture.cameras[0].viewmat, make_camera(2, "cam1").viewmat, atol=1e-12)
    assert capture.cameras[0].K[0, 2] == WIDTH / 2 + 3
    np.testing.assert_allclose(capture.points, points)
    assert_close(capture.point_colors, points / 5, atol=1 / 255)


@pytest.mark.usefixtures("small_images")
@pytest.mark.parametrize("downscale", [2, 3, 4.5])
def test_load_capture__downscaling_moves_projections_with_the_pixels(
    tmp_path: Path, downscale: float
) -> None:
    full = make_camera(0, "cam01", shift=3.0)
    write_colmap(tmp_path / "sparse", [full])
    point = np.array([0.03, 0.05, 0.02])
    u, v = full.project(point)[0]
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    blob = 250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 50)
    write_video(tmp_path / "cam01", [np.repeat(blob[..., None], 3, -1).astype(np.uint8)], FPS)

    capture = load_capture(tmp_path, downscale)
    small = capture.cameras[0]
    assert (small.width, small.height) == (round(WIDTH / downscale), round(HEIGHT / downscale))
    image = next(capture.frames()).images[0][..., 0].astype(float)
    assert image.shape == (small.height, small.width)
    rows, columns = np.mgrid[: small.height, : small.width] + 0.5
    centre = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    assert_close(centre, small.project(point)[0], atol=0.05)


@pytest.mark.usefixtures("small_images")
def test_load_capture__undistorts_and_masks(tmp_path: Path) -> None:
    colmap(tmp_path, lenses=[Lens("SIMPLE_RADIAL", (0.3,)), Lens()])
    full = load_capture(tmp_path)
    small = load_capture(tmp_path, 2)
    assert (full.downscale, small.downscale) == (1, 2)
    assert full.masks[1] is None
    assert full.masks[0] is not None
    assert small.masks[0] is not None
    assert full.masks[0].shape == (HEIGHT, WIDTH)
    assert small.masks[0].shape == (HEIGHT // 2, WIDTH // 2)
    # A downscaled pixel is valid exactly where the four that it averages are.
    blocks = full.masks[0].reshape(HEIGHT // 2, 2, WIDTH // 2, 2).all(axis=(1, 3))
    np.testing.assert_array_equal(small.masks[0], blocks)


def test_load_capture__prefers_lossless_frames(tmp_path: Path) -> None:
    n3dv(tmp_path)
    write_video(tmp_path / "frames" / "cam01", frames(77), FPS)
    images = next(load_capture(tmp_path).frames()).images
    assert [image[0, 0, 0] for image in images] == [0, 77, 2]


def test_load_capture__reads_frame_folders_named_in_the_model(tmp_path: Path) -> None:
    names = ("cam01", "cam02")
    write_colmap(
        tmp_path / "sparse", [make_camera(i, f"{n}/0000.png") for i, n in enumerate(names)]
    )
    for i, name in enumerate(names):
        write_video(tmp_path / name, frames(i), FPS)
    (tmp_path / "capture.json").write_text('{"fps": 24}')
    capture = load_capture(tmp_path)
    assert (capture.names, capture.fps) == (names, 24)


def test_load_capture__selects_the_held_out_view(tmp_path: Path) -> None:
    n3dv(tmp_path, tuple(f"cam{i:02}" for i in range(6)))
    capture = load_capture(tmp_path)
    assert capture.test_views == (0,)
    assert capture.train_views == (1, 2, 3, 4, 5)
    assert load_capture(tmp_path, test_view=None).test_views == ()
    (tmp_path / "capture.json").write_text('{"test_view": 4}')
    assert load_capture(tmp_path).test_views == (4,)
    assert load_capture(tmp_path, test_view=2).test_views == (2,)
    assert load_capture(tmp_path, test_view=[5, "cam00", 0]).test_views == (0, 5)
    (tmp_path / "capture.json").write_text('{"test_view": [4, 1]}')
    assert load_capture(tmp_path).test_views == (1, 4)
    assert load_capture(tmp_path).train_views == (0, 2, 3, 5)
    (tmp_path / "capture.json").write_text('{"test_view": null}')
    assert load_capture(tmp_path).test_views == ()


def test_load_capture__finds_truth_and_limits_frames(tmp_path: Path) -> None:
    (n3dv(tmp_path) / "truth").mkdir()
    capture = load_capture(tmp_path, max_frames=2)
    assert capture.truth == tmp_path / "truth"
    assert capture.num_frames == len(list(capture.frames())) == 2


def test_load_capture__leaves_out_uncalibrated_clips_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_video(colmap(tmp_path) / "cam03.mp4", frames(3), FPS)
    with caplog.at_level(logging.WARNING):
        assert load_capture(tmp_path).names == ("cam01", "cam02")
    assert "does not calibrate cam03" in caplog.text


@pytest.mark.parametrize("without", [["cam02"], ["cam02", "cam03"]])
def test_load_capture__leaves_cameras_out(tmp_path: Path, without: list[str]) -> None:
    names = tuple(f"cam{i:02}" for i in range(8))
    path = n3dv(tmp_path, names)
    (path / "cam02.mp4").write_bytes(b"")  # a clip that is not used is not opened
    (path / "capture.json").write_text('{"test_view": 4, "readout": {"cam02": 0.5, "cam05": 0.2}}')
    capture = load_capture(path, reading=ReadConfig(without=tuple(without)))
    remainder = [name for name in names if name not in without]
    assert capture.names == tuple(remainder)
    (test_view,) = capture.test_views
    assert capture.names[test_view] == "cam04", "the setting counts all cameras"
    assert {c.name: c.readout for c in capture.cameras if c.readout} == {"cam05": 0.2}
    assert [image[0, 0, 0] for image in next(capture.frames()).images] == [
        names.index(name) for name in remainder
    ]
    assert load_capture(
        path, test_view=2, reading=ReadConfig(without=tuple(without))
    ).test_views == (2,)


def test_load_capture__holds_out_another_view_without_the_one_of_the_settings(
    tmp_path: Path,
) -> None:
    path = n3dv(tmp_path, tuple(f"cam{i:02}" for i in range(8)))
    (path / "capture.json").write_text('{"test_view": 4}')
    assert load_capture(path, reading=ReadConfig(without=("cam04",))).test_views == (0,)
    assert (
        load_capture(path, reading=ReadConfig(without=("cam04", "cam06", "cam07"))).test_views == ()
    )


@pytest.mark.parametrize(
    ("without", "message"),
    [
        (("cam02", "cam09"), "`without` must name cameras of cam01, cam02, got cam09."),
        (("cam02", "cam01"), "`without` must leave at least one camera, got all: cam01, cam02."),
    ],
)
def test_load_capture__refuses_to_leave_out_unknown_or_all_cameras(
    tmp_path: Path, without: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        load_capture(colmap(tmp_path), reading=ReadConfig(without=without))


def no_folder(path: Path) -> None:
    shutil.rmtree(path)


def no_videos(path: Path) -> None:
    [video.unlink() for video in path.glob("*.mp4")]


def other_size(path: Path) -> None:
    write_video(path / "cam02.mp4", frames(1, width=WIDTH - 2), FPS)


def two_images_of_a_camera(path: Path) -> None:
    write_colmap(path / "sparse/0", [make_camera(0, "cam01"), make_camera(1, "cam01/0001.png")])


def bad_settings(path: Path) -> None:
    (path / "capture.json").write_text(json.dumps({"test_view": "cam01"}))


def bad_readout(path: Path) -> None:
    (path / "capture.json").write_text('{"readout": {"cam01": 2}}')


def readout_of_another(path: Path) -> None:
    (path / "capture.json").write_text('{"readout": {"cam07": 0.4}}')


def broken_settings(path: Path) -> None:
    (path / "capture.json").write_text("{")


def test_with_cameras__reads_as_if_the_calibration_had_the_lens(tmp_path: Path) -> None:
    path = colmap(tmp_path / "capture")
    terms = (-0.12, 0.02)
    capture = load_capture(path)
    assert capture.with_cameras(capture.cameras).distortions == ()
    cameras = [square(camera) for camera in capture.cameras]
    recording = replace(capture, cameras=tuple(cameras)).with_cameras(
        cameras, [terms] * len(cameras)
    )
    points = np.zeros((1, 3))
    write_colmap(
        path / "sparse" / "0", cameras, points, points, [Lens("RADIAL", terms)] * len(cameras)
    )
    expected = load_capture(path)
    for images in zip(*(next(c.frames(0, 1)).images for c in (expected, recording)), strict=True):
        assert np.array_equal(*images)
    assert all(np.array_equal(a, b) for a, b in zip(expected.masks, recording.masks, strict=True))
    assert recording.distortions == (terms,) * len(cameras)


def square(camera: Camera) -> Camera:
    """Return a camera with equal focal lengths, as in the lens models with one focal length."""
    K = camera.K.copy()
    K[1, 1] = K[0, 0]
    return replace(camera, K=K)


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (no_folder, FileNotFoundError, "expected a capture folder, found none"),
        (no_videos, FileNotFoundError, r"expected videos \(.mp4"),
        (
            other_size,
            ValueError,
            "cam02.mp4: expected 62x46, the calibrated size of cam02, or a scaled version of it, "
            "got 60x46",
        ),
        (
            two_images_of_a_camera,
            ValueError,
            "cameras must not move, but 'cam01.png' and 'cam01/0001.png', both of cam01, have",
        ),
        (
            bad_settings,
            ValueError,
            "capture.json: `test_view` must be a camera's index, a list of them, or null, got "
            "'cam01'",
        ),
        (bad_readout, ValueError, r"capture.json: `readout` must be a number in \[-1, 1\], got 2"),
        (
            readout_of_another,
            ValueError,
            "capture.json: `readout` must name cameras of cam01, cam02, .*got cam07",
        ),
        (broken_settings, ValueError, "capture.json: expected JSON"),
    ],
)
def test_load_capture__refuses_broken_captures(
    tmp_path: Path, damage, error: type[Exception], message: str
) -> None:
    path = colmap(tmp_path / "capture")
    damage(path)
    with pytest.raises(error, match=message):
        load_capture(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"downscale": 2},
            r"`downscale` must leave .* at least 32 pixels on each side, got 2; use at most 1.43",
        ),
        ({"downscale": 1e300}, r"on each side, got 1e\+300; use at most 1.43"),
        ({"downscale": 0.5}, "`downscale` must be at least 1, got 0.5"),
        ({"downscale": float("nan")}, "`downscale` must be at least 1, got nan"),
        ({"max_frames": 0}, "`max_frames` must be at least 1, got 0"),
        ({"test_view": 2}, r"`test_view` must be an index in 0..1, one of .*, or none .* got 2"),
        (
            {"test_view": ["cam01", 7]},
            r"`test_view` must be an index in 0..1, one of .*, or none .* got 7",
        ),
        (
            {"test_view": [0, "cam02"]},
            "`test_view` must leave a camera for training, got all 2 cameras",
        ),
        ({"test_view": -1}, r"`test_view` must be an index in 0..1, one of .*, or none .* got -1"),
    ],
)
def test_load_capture__refuses_bad_arguments(tmp_path: Path, arguments: dict, message: str) -> None:
    path = colmap(tmp_path)
    with pytest.raises(ValueError, match=message):
        load_capture(path, **arguments)


def test_load_capture__accepts_the_largest_downscale(tmp_path: Path) -> None:
    camera = load_capture(colmap(tmp_path), 1.43).cameras[0]
    assert min(camera.width, camera.height) == 32


@pytest.mark.parametrize("colors", [[[0, 0, 300]], [[-1, 0, 0]]])
def test_load_capture__refuses_point_colours_out_of_range(tmp_path: Path, colors: list) -> None:
    path = colmap(tmp_path, points=np.zeros((1, 3)))
    (row,) = (
        line for line in (path / "sparse/0/points3D.txt").read_text().splitlines() if line[0] != "#"
    )
    fields = [*row.split()[:4], *map(str, colors[0]), "0.5"]
    (path / "sparse/0/points3D.txt").write_text(" ".join(fields) + "\n")
    with pytest.raises(ValueError, match=r"`point_colors` must be in \[0, 1\], got .*; divide"):
        load_capture(path)


def test_load_capture__does_not_clip_the_colours_of_a_point_cloud(tmp_path: Path) -> None:
    path = layouts.dynamic3dgs(tmp_path / "a")
    np.savez(path / "init_pt_cld.npz", data=[[1, 2, 3, 128, 255, 0, 1]])
    with pytest.raises(ValueError, match=r"in \[0, 1\], got \[128.0, 255.0, 0.0\] at 0; divide"):
        load_capture(path)


# ---- images with other channels
# --------------------------------------------------------------------------


def transparent(t: int = 0, kind: type = np.uint8) -> np.ndarray:
    """Return an image [H, W, 4]; its left 10 columns and column 20 + t are transparent."""
    image = np.full((HEIGHT, WIDTH, 4), np.iinfo(kind).max, kind)
    image[:, :10, 3] = 0
    image[:, 20 + t, 3] = np.iinfo(kind).max // 2
    return image


def with_images(path: Path, images: list[np.ndarray], **kwargs) -> Path:
    """Write a capture of one camera with images of any channels and type."""
    write_colmap(path / "sparse", [make_camera(0, "cam01")], **kwargs)
    (path / "cam01").mkdir()
    for t, image in enumerate(images):
        cv2.imwrite(str(path / "cam01" / f"{t}.png"), image)
    return path


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_load_capture__masks_transparent_pixels(tmp_path: Path, kind: type) -> None:
    capture = load_capture(with_images(tmp_path, [transparent(kind=kind)] * 3))
    assert capture.masks[0] is not None
    np.testing.assert_array_equal(capture.masks[0], transparent()[..., 3] == 255)
    assert capture.notes == (
        f"cam01: {1100 / WIDTH:.1f} % of its pixels are transparent and masked out.",
    )
    assert capture.metadata()["cameras"][0]["valid_share"] == pytest.approx(1 - 11 / WIDTH)


def test_load_capture__masks_what_transparent_pixels_contribute_to(
    tmp_path: Path, small_images: None
) -> None:
    lens = Lens("SIMPLE_RADIAL", (0.05,))
    images = [transparent()] * 2
    images[0][images[0][..., 3] < 255, :3] = 0
    capture = load_capture(with_images(tmp_path, images, lenses=[lens]), 2)
    (image,) = next(capture.frames()).images
    assert capture.masks[0] is not None
    assert 0.5 < capture.masks[0].mean() < 1
    assert (image[capture.masks[0]] == 255).all(), "no black has leaked into a valid pixel"
    assert (image[~capture.masks[0]] < 255).any()


def test_load_capture__ignores_an_alpha_channel_that_changes(tmp_path: Path) -> None:
    capture = load_capture(with_images(tmp_path, [transparent(t) for t in range(3)]))
    assert capture.masks == (None,)
    assert capture.notes == (
        "cam01: the alpha channel of its images changes over time and is ignored.",
    )


def test_load_capture__does_not_mask_opaque_images(tmp_path: Path) -> None:
    opaque = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    capture = load_capture(with_images(tmp_path, [opaque] * 2))
    assert (capture.masks, capture.notes) == ((None,), ())


def test_load_capture__refuses_images_without_opaque_pixels(tmp_path: Path) -> None:
    path = with_images(tmp_path, [np.zeros((HEIGHT, WIDTH, 4), np.uint8)])
    with pytest.raises(
        ValueError,
        match=r"cam01: expected opaque pixels, got an alpha channel without any; remove it",
    ):
        load_capture(path)


@pytest.mark.parametrize(
    "image",
    [np.full((HEIGHT, WIDTH), 200, np.uint8), np.full((HEIGHT, WIDTH, 3), 200 * 257, np.uint16)],
    ids=["grey", "16 bits"],
)
def test_load_capture__reads_grey_and_16_bit_images(tmp_path: Path, image: np.ndarray) -> None:
    capture = load_capture(with_images(tmp_path, [image]))
    assert (next(capture.frames()).images[0] == 200).all()


# ---- photos
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["", "images", "photos"])
def test_load_capture__reads_photos_as_cameras_of_one_frame(tmp_path: Path, place: str) -> None:
    names = ("IMG_2", "IMG_3", "IMG_10")
    write_colmap(tmp_path / "sparse/0", rig(names))
    for i, name in enumerate(names):
        # The latter as Nerfstudio's downscaled copies.
        for folder in (tmp_path / place, tmp_path / "images_2"):
            folder.mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"{name}.png"), frames(i)[0][..., ::-1])
    capture = load_capture(tmp_path)
    assert (capture.names, capture.num_frames) == (names, 1)
    assert [image[0, 0, 0] for image in next(capture.frames()).images] == [0, 1, 2]
    (note,) = capture.notes
    assert (
        "3 photos of a static scene, one per camera; a recording has one folder per camera: "
        "cam01/0000.png" in note
    )


def test_load_capture__describes_the_folders_that_photos_lack(tmp_path: Path) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"found none; .*, or make one folder per camera: cam01/0000"
    ):
        load_capture(tmp_path)
    cv2.imwrite(str(tmp_path / "IMG_1.png"), frames(0)[0])
    with pytest.raises(
        FileNotFoundError,
        match=r"run `morgs-mi calibrate`.* The 1 photos .* one folder per camera: c",
    ):
        load_capture(tmp_path)
    with pytest.raises(
        ValueError, match=r"at least two cameras, found IMG_1; .* one folder per camera: cam01/"
    ):
        calibrate(tmp_path)
