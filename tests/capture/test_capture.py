"""Whole capture folders: layouts, order, downscaling, and broken ones."""

import weakref
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import Lens
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.video_writer import write_video
from morgs_mi.testing import assert_close
from tests.scenes import captures as layouts
from tests.scenes.captures import (
    FPS,
    HEIGHT,
    WIDTH,
    dot_clips,
    frames,
    make_camera,
    rig,
    shown_dot,
    videos,
)

PINHOLE = Lens()


def colmap(path):
    names = ("cam01", "cam02")
    write_colmap(path / "sparse" / "0", rig(names, shift=3.0))
    videos(path, names, ".mp4")
    return path


def test_frames__releases_the_images_of_past_frames(tmp_path):
    """Memory does not grow with the length of a clip."""
    folder = layouts.n3dv(tmp_path / "a")
    for i, clip in enumerate(folder.glob("*.mkv")):
        write_video(clip, frames(i, count=40), FPS)
    references = []
    for frame in load_capture(folder).frames():
        references.append(weakref.ref(frame.images[0]))
        del frame
        assert sum(reference() is not None for reference in references) <= 3
    assert len(references) == 40


@pytest.mark.usefixtures("small_images")
@pytest.mark.parametrize("downscale", [2, 3, 4.5])
def test_load_capture__downscaling_moves_projections_with_the_pixels(tmp_path, downscale):
    names = ("cam01", "cam02")
    point = np.array([0.03, 0.05, 0.02])
    write_colmap(tmp_path / "sparse", rig(names, shift=3.0))
    dot_clips(tmp_path, names, point, (0.0, 0, 0, 0), deviation=5)
    capture = load_capture(tmp_path, downscale)
    for camera, image in zip(capture.cameras, next(capture.frames()).images, strict=True):
        assert image.shape == (round(HEIGHT / downscale), round(WIDTH / downscale), 3)
        assert image.shape[:2] == (camera.height, camera.width)
        assert_close(shown_dot(image), camera.project(point)[0], atol=0.1)


def test_frames__ends_with_the_last_frame_of_the_capture(tmp_path):
    capture = replace(load_capture(layouts.n3dv(tmp_path / "a")), num_frames=2)
    assert [frame.index for frame in capture.frames()] == [0, 1]
    assert len(list(capture.images(0, 1, 9))) == 1


def test_load_capture__prefers_lossless_frames(tmp_path):
    path = layouts.n3dv(tmp_path / "a")
    write_video(path / "frames" / "cam02", frames(77), FPS)
    images = next(load_capture(path).frames()).images
    assert [image[0, 0, 0] for image in images] == [0, 77, 2]


def test_load_capture__selects_the_held_out_view(tmp_path):
    path = layouts.n3dv(tmp_path / "a", tuple(f"cam{i:02}" for i in range(6)))
    capture = load_capture(path)
    assert capture.test_views == (0,)
    assert capture.train_views == (1, 2, 3, 4, 5)
    assert load_capture(path, test_view=None).test_views == ()
    (path / "capture.json").write_text('{"test_view": 4}')
    assert load_capture(path).test_views == (4,)
    assert load_capture(path, test_view=2).test_views == (2,)
    assert load_capture(path, test_view=[5, "cam00", 0]).test_views == (0, 5)
    (path / "capture.json").write_text('{"test_view": [4, 1]}')
    assert load_capture(path).test_views == (1, 4)
    (path / "capture.json").write_text('{"test_view": null}')
    assert load_capture(path).test_views == ()


def test_load_capture__leaves_out_uncalibrated_clips_with_a_warning(tmp_path, caplog):
    write_video(colmap(tmp_path) / "cam03.mp4", frames(3), FPS)
    assert load_capture(tmp_path).names == ("cam01", "cam02")
    assert "does not calibrate cam03" in caplog.text


def test_load_capture__leaves_cameras_out(tmp_path):
    names = tuple(f"cam{i:02}" for i in range(8))
    path = layouts.n3dv(tmp_path / "a", names)
    (path / "cam02.mkv").write_bytes(b"")  # a clip that is not used is not opened
    (path / "capture.json").write_text('{"test_view": 4, "readout": {"cam02": 0.5, "cam05": 0.2}}')
    reading = ReadConfig(without=("cam02", "cam03"))
    capture = load_capture(path, reading=reading)
    assert capture.names == (*names[:2], *names[4:])
    assert capture.test_views == (2,), "the setting counts all cameras"
    assert [camera.readout for camera in capture.cameras] == [0, 0, 0, 0.2, 0, 0]
    assert [image[0, 0, 0] for image in next(capture.frames()).images] == [0, 1, 4, 5, 6, 7]
    assert load_capture(path, test_view=2, reading=reading).test_views == (2,)


def test_load_capture__holds_out_another_view_without_the_one_of_the_settings(tmp_path):
    path = layouts.n3dv(tmp_path / "a", tuple(f"cam{i:02}" for i in range(8)))
    (path / "capture.json").write_text('{"test_view": 4}')
    assert load_capture(path, reading=ReadConfig(without=("cam04",))).test_views == (0,)
    assert (
        load_capture(path, reading=ReadConfig(without=("cam04", "cam06", "cam07"))).test_views == ()
    )


def test_with_cameras__reads_as_if_the_calibration_had_the_lens(tmp_path):
    path = colmap(tmp_path / "capture")
    terms = (-0.12, 0.02)
    capture = load_capture(path)
    cameras = [square(camera) for camera in capture.cameras]
    recording = capture.with_cameras(cameras).with_cameras(cameras, [terms] * len(cameras))
    points = np.zeros((1, 3))
    images = [CalibratedImage(camera, Lens("RADIAL", terms)) for camera in cameras]
    write_colmap(path / "sparse" / "0", images, points, points)
    expected = load_capture(path)
    for images in zip(*(next(c.frames(0, 1)).images for c in (expected, recording)), strict=True):
        assert np.array_equal(*images)
    assert np.array_equal(expected.masks, recording.masks)


def square(camera):
    """Return a camera with equal focal lengths, as in the lens models with one focal length."""
    K = camera.K.copy()
    K[1, 1] = K[0, 0]
    return replace(camera, K=K)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            '{"test_view": "cam07"}',
            r"`test_view` must be an index in 0..\d or one of .*, got .cam07",
        ),
        ('{"readout": {"cam01": 2}}', "`readout` must be .* each value at least -1 and at most 1"),
        (
            '{"readout": {"cam07": 0.4}}',
            "`readout` must name cameras of cam01, cam02, .*got cam07",
        ),
        ("{", "expected JSON"),
    ],
)
def test_load_capture__refuses_broken_settings(tmp_path, settings, message):
    (colmap(tmp_path) / "capture.json").write_text(settings)
    with pytest.raises(ValueError, match=f"capture.json: {message}"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"downscale": 2},
            r"`downscale` must leave images of at least 32 pixels .*, got 2; use at most 1.43",
        ),
        ({"downscale": float("nan")}, r"`downscale` must be a number in \[1, inf\), got nan"),
        ({"max_frames": 0}, r"`max_frames` must be a number in \[1, inf\), got 0"),
        (
            {"reading": ReadConfig(without=("cam02", "cam09"))},
            "`without` must name cameras of cam01, cam02, got cam09.",
        ),
        (
            {"reading": ReadConfig(without=("cam02", "cam01"))},
            "`without` must leave at least one camera, got all.",
        ),
        ({"test_view": 2}, r"`test_view` must be an index in 0..1 or one of .*, got 2"),
        (
            {"test_view": [0, "cam02"]},
            "`test_view` must leave a camera for training, got all",
        ),
    ],
)
def test_load_capture__refuses_bad_arguments(tmp_path, arguments, message):
    path = colmap(tmp_path)
    with pytest.raises(ValueError, match=message):
        load_capture(path, **arguments)


# ---- images with other channels
# --------------------------------------------------------------------------


def transparent(t=0, kind=np.uint8):
    """Return an image [H, W, 4]; its left 10 columns and column 20 + t are transparent."""
    image = np.full((HEIGHT, WIDTH, 4), np.iinfo(kind).max, kind)
    image[:, :10, 3] = 0
    image[:, 20 + t, 3] = np.iinfo(kind).max // 2
    return image


def with_images(path, images, lens=PINHOLE):
    """Write a capture of one camera with images of any channels and type."""
    write_colmap(path / "sparse", [CalibratedImage(make_camera(0, "cam01"), lens)])
    (path / "cam01").mkdir()
    for t, image in enumerate(images):
        cv2.imwrite(str(path / "cam01" / f"{t}.png"), image)
    return path


OPAQUE = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)


@pytest.mark.parametrize(
    ("images", "masked", "note"),
    [
        ([transparent()] * 3, True, f"{1100 / WIDTH:.1f} % of its pixels are transparent and "),
        ([transparent(kind=np.uint16)], True, "transparent and masked out."),
        ([transparent(t) for t in range(3)], False, "the alpha channel of its images changes "),
        ([OPAQUE] * 2, False, ""),
    ],
)
def test_load_capture__masks_transparent_pixels(tmp_path, images, masked, note):
    capture = load_capture(with_images(tmp_path, images))
    assert note in "".join(capture.notes)
    assert bool(note) == bool(capture.notes)
    assert (capture.masks[0] is not None) == masked
    if masked:
        assert_array_equal(capture.masks[0], transparent()[..., 3] == 255)
        assert capture.metadata()["cameras"][0]["valid_share"] == pytest.approx(1 - 11 / WIDTH)


def test_load_capture__masks_what_transparent_pixels_contribute_to(tmp_path, small_images):
    lens = Lens("SIMPLE_RADIAL", (0.05,))
    images = [transparent()] * 2
    images[0][images[0][..., 3] < 255, :3] = 0
    capture = load_capture(with_images(tmp_path, images, lens), 2)
    (image,) = next(capture.frames()).images
    assert 0.5 < capture.masks[0].mean() < 1
    assert (image[capture.masks[0]] == 255).all(), "no black has leaked into a valid pixel"
    assert (image[~capture.masks[0]] < 255).any()


# ---- photos
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["", "images", "photos"])
def test_load_capture__reads_photos_as_cameras_of_one_frame(tmp_path, place):
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


def test_load_capture__describes_the_folders_that_photos_lack(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"found none; .*, or make one folder per camera: cam01/0000"
    ):
        load_capture(tmp_path)
    cv2.imwrite(str(tmp_path / "IMG_1.png"), frames(0)[0])
    with pytest.raises(
        FileNotFoundError,
        match=r"run `morgs-mi calibrate` on the folder, which has .* photos of 1 camera",
    ):
        load_capture(tmp_path)
