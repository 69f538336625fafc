"""Nerfstudio's `transforms.json`: lenses, masks, splits, sizes and keys of its exporters; the two
files of NeRF's synthetic scenes.
"""

import json
from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.clips import size_of_clip
from morgs_mi.capture.layouts.nerfstudio import READER
from morgs_mi.platform.bounded import read_json
from morgs_mi.testing import assert_close
from tests.capture.layouts.test_layouts import edit
from tests.scenes import captures as layouts
from tests.scenes.captures import HEIGHT, WIDTH

NAMES = ("cam1", "cam2", "cam10")
PIXEL_ABS = 1e-6  # the file stores float64


def photos(path, folder="images", suffix=".png", change=lambda meta: None):
    """Write three photos and their `transforms.json`, after `change`."""
    layouts.nerfstudio(path)
    for i, name in enumerate(NAMES):
        (path / f"{name}.mkv").unlink()
        layouts.write_image(path / folder / f"{name}{suffix}", i, 0)

    def name_photos(meta):
        for frame, name in zip(meta["frames"], NAMES, strict=True):
            frame["file_path"] = f"{folder}/{name}{suffix}"
        meta["k1"] = 0
        change(meta)

    edit(path, name_photos)
    return path


def write_mask(file, mask):
    file.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(file), mask.astype(np.uint8))


def left_half(value=255):
    """Return an image that is black in its left half."""
    return np.where(np.arange(WIDTH) < WIDTH // 2, 0, value) + np.zeros((HEIGHT, 1), int)


def lenses(capture):
    return [(view["lens"], view["distortion"]) for view in capture.metadata()["cameras"]]


@pytest.mark.parametrize("camera_model", [None, "OPENCV", "OPENCV_FISHEYE"])
def test_nerfstudio__reads_fisheyes_by_their_flag(tmp_path, camera_model):
    def change(meta):
        meta.pop("camera_model")
        meta.update(
            {"is_fisheye": True, "k1": 0.01}
            | ({"camera_model": camera_model} if camera_model else {})
        )
        meta["frames"][1]["is_fisheye"] = False

    first, second, _ = lenses(load_capture(photos(tmp_path / "a", change=change)))
    assert first == ("OPENCV_FISHEYE", [0.01, 0, 0, 0])
    assert second[0] == ("OPENCV_FISHEYE" if camera_model == "OPENCV_FISHEYE" else "OPENCV")


@pytest.mark.usefixtures("small_images")
def test_nerfstudio__combines_masks_with_alpha_lens_and_downscaling(tmp_path):
    def change(meta):
        meta.update(mask_path="masks/all.png", k1=0.3)

    path = photos(tmp_path / "a", change=change)
    write_mask(path / "masks/all.png", left_half())
    rows = np.where(np.arange(HEIGHT) < 10, 0, 255)[:, None] + np.zeros((1, WIDTH), int)
    cv2.imwrite(
        str(path / "images/cam1.png"),
        np.dstack([*[np.full((HEIGHT, WIDTH), 9)] * 3, rows]).astype(np.uint8),
    )
    full = load_capture(path)
    first, second, _ = full.masks
    assert not (first & ~full.views[0].undistortion.mask).any()
    assert not first[:, : WIDTH // 2 - 2].any()
    assert not first[:8].any()
    assert second[:8].any()
    blocks = first.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).all(axis=(1, 3))
    assert_array_equal(load_capture(path, 2).masks[0], blocks)


def test_nerfstudio__masks_what_any_mask_of_a_camera_has_black(tmp_path):
    path = layouts.nerfstudio(tmp_path / "a")

    def change(meta):
        first = meta["frames"][0] | {"file_path": "cam1/0000.png", "mask_path": "masks/a.png"}
        meta["frames"][0] = first
        meta["frames"].append(first | {"file_path": "cam1/0001.png", "mask_path": "masks/b.png"})
        meta["k1"] = 0

    edit(path, change)
    write_mask(path / "masks/a.png", left_half())
    write_mask(path / "masks/b.png", 255 - left_half())
    with pytest.raises(ValueError, match="expected pixels of cam1 that are used"):
        load_capture(path)
    write_mask(path / "masks/a.png", left_half(1))
    write_mask(path / "masks/b.png", np.full((2 * HEIGHT, 2 * WIDTH), 255))
    capture = load_capture(path)
    assert_array_equal(capture.masks[0], left_half() > 0)
    assert "cam1: 50.0 % of its pixels are masked out by a.png, b.png." in capture.notes
    write_mask(path / "masks/b.png", np.full((HEIGHT, HEIGHT), 255))
    with pytest.raises(ValueError, match=r"b.png: expected a mask of 62x46, or scaled, got 46x46"):
        load_capture(path)
    (path / "masks/b.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"b.png: expected a mask, found none"):
        load_capture(path)


def synthetic(path, parts, cameras, suffix=""):
    """Write photos and the files of NeRF's synthetic scenes, which state an angle of view and no
    size; `parts` are the names of the folders, of a camera each.
    """
    for i, (part, camera) in enumerate(zip(parts, cameras, strict=True)):
        layouts.write_image(path / part / f"{camera.name}.png", i, 0)
        layouts.transforms(path, [replace(camera, name=f"./{part}/{camera.name}{suffix}")])
        (frame,) = read_json(path / "transforms.json")["frames"]
        file = path / f"transforms_{part}.json"
        angle = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / camera.K[0, 0]), "frames": []}
        meta = read_json(file) if file.exists() else angle
        pose = {key: frame[key] for key in ("file_path", "transform_matrix")}
        meta["frames"].append(pose | {"rotation": 0.1})
        file.write_text(json.dumps(meta))
        (path / "transforms.json").unlink()
    return path


def square(names):
    """Return cameras on a circle with equal intrinsics."""
    cameras = layouts.rig(names)
    return [replace(camera, K=cameras[0].K) for camera in cameras]


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_nerfstudio__reads_synthetic_scenes(tmp_path, suffix):
    """Images of different splits have the same names."""
    cameras = square(("r_0", "r_1", "r_0"))
    path = synthetic(tmp_path / "a", ("train", "train", "test"), cameras, suffix)
    capture = load_capture(path)
    assert capture.layout == "Nerfstudio"
    assert (capture.names, capture.test_views) == (("test_r_0", "train_r_0", "train_r_1"), (0,))
    for camera, i in zip(capture.cameras, (2, 0, 1), strict=True):
        assert_close(camera.viewmat, cameras[i].viewmat, atol=1e-9)
        assert_close(camera.K, cameras[i].K, atol=PIXEL_ABS)
    assert [image[20, 30, 0] for image in next(capture.frames()).images] == [2, 0, 1]


def test_nerfstudio__reads_a_synthetic_scene_without_held_out_images(tmp_path):
    path = synthetic(tmp_path / "a", ("train", "train"), square(("r_0", "r_1")))
    assert READER.read(path).held_out is None
    assert load_capture(path).names == ("r_0", "r_1")
    # BlenderNeRF writes an empty file of held-out images on request.
    (path / "transforms_test.json").write_text('{"camera_angle_x": 0.7, "frames": []}')
    assert READER.read(path).held_out == ()
    assert load_capture(path).names == ("r_0", "r_1")


def test_nerfstudio__names_the_files_that_it_does_not_read(tmp_path, caplog):
    """A `transforms.json` beside the two files has the held-out images, too."""
    cameras = square(("r_0", "r_1", "r_2", "r_3"))
    path = synthetic(tmp_path / "a", ("train", "train", "test", "val"), cameras)
    layouts.transforms(path, [replace(camera, name="train/r_0") for camera in cameras[:1]])
    capture = load_capture(path)
    assert (capture.names, capture.test_views) == (("r_0", "r_1", "r_2"), (2,))
    assert caplog.messages == [
        f"{path}: not used: transforms.json, transforms_val.json.",
        f"{path / 'transforms_train.json'} does not calibrate r_3: not used.",
    ]


# ---- recordings in one folder
# ----------------------------------------------------------------------------


def flat(path, names, times=(0, 1), has_time=True):
    """Write a recording whose names have the camera and the time, and its `transforms.json`, which
    has the times, too, with `has_time`.
    """
    cameras = []
    for i, camera in enumerate(layouts.rig(("a", "b", "c"))):
        for t in times:
            name = names.format(camera="abc"[i], time=t)
            layouts.write_image(path / "images" / name, i, t)
            cameras.append(replace(camera, name=f"images/{name}"))
    layouts.transforms(path, cameras)

    def add_times(meta):
        for k, entry in enumerate(meta["frames"]):
            entry["time"] = times[k % len(times)] / 30

    if has_time:
        edit(path, add_times)
    return path


@pytest.mark.parametrize("names", ["{camera}_{time:04}.png", "{time}_{camera}.jpg"])
@pytest.mark.parametrize("has_time", [True, False])
@pytest.mark.parametrize("times", [(0, 1), (0, 2)])
def test_nerfstudio__reads_a_recording_in_one_folder(tmp_path, names, has_time, times):
    capture = load_capture(flat(tmp_path / "a", names, times, has_time))
    assert capture.names == tuple(names.format(camera=c, time=0)[:-4] for c in "abc")
    assert capture.num_frames == 2
    assert capture.notes == ()
    for t, frame in zip(times, capture.frames(), strict=True):
        expected = np.array([(i, t) for i in range(3)])
        assert_close([image[20, 30, :2] for image in frame.images], expected, atol=1)


def test_nerfstudio__holds_out_a_camera_of_a_recording_in_one_folder(tmp_path, caplog):
    path = flat(tmp_path / "a", "{camera}_{time}.png")
    meta = read_json(path / "transforms.json")
    for part, entries in (("train", meta["frames"][:4]), ("test", meta["frames"][4:])):
        file = path / f"transforms_{part}.json"
        file.write_text(json.dumps(meta | {"frames": entries}))
    (path / "transforms.json").unlink()
    write_mask(path / "masks/b_0.png.png", left_half())
    write_mask(path / "masks/b_1.png.png", left_half())
    capture = load_capture(path)
    assert (capture.names, capture.test_views) == (("a_0", "b_0", "c_0"), (2,))
    assert capture.num_frames == 2
    assert_array_equal(capture.masks[1], left_half() > 0)
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (["c_3"], "same numbers without gaps, got a_0 to a_3, b_0 to b_3, c_0 to c_2; leave out"),
        (["a_0", "a_1", "a_3", "b_0", "b_1", "b_3"], "got a_2 to a_2, b_2 to b_2, c_0 to c_3"),
    ],
)
def test_nerfstudio__refuses_a_recording_in_one_folder_with_gaps(tmp_path, gone, message):
    path = flat(tmp_path / "a", "{camera}_{time}.png", (0, 1, 2, 3))

    def leave_out(meta):
        meta["frames"] = [f for f in meta["frames"] if f["file_path"][7:-4] not in gone]

    edit(path, leave_out)
    with pytest.raises(ValueError, match=f"transforms.json: images of equal pose .* {message}"):
        load_capture(path)


ANGLES = {
    "camera_angle_x": 2 * np.arctan(WIDTH / 100),
    "camera_angle_y": 2 * np.arctan(HEIGHT / 100),
}


@pytest.mark.parametrize(
    ("values", "suffix", "has_suffix"), [({"fl_x": 50.0}, ".JPG", True), (ANGLES, ".tif", False)]
)
def test_nerfstudio__takes_missing_sizes_from_the_images(tmp_path, values, suffix, has_suffix):
    def change(meta):
        del meta["w"], meta["h"]
        for frame in meta["frames"]:
            for key in ("fl_x", "fl_y", "cx", "cy"):
                del frame[key]
            frame.update(values)
            if not has_suffix:
                frame["file_path"] = "./" + frame["file_path"].removesuffix(suffix)

    capture = load_capture(photos(tmp_path / "a", "train", suffix, change))
    assert capture.names == NAMES
    for camera in capture.cameras:
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert_close(camera.K, [[50, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]], atol=PIXEL_ABS)


def test_nerfstudio__takes_missing_sizes_from_clips_once_and_leaves_out_missing_ones(
    tmp_path, monkeypatch
):
    path = layouts.nerfstudio(tmp_path / "a")

    def change(meta):
        del meta["w"], meta["h"]
        meta["frames"] *= 3  # three images of each clip

    edit(path, change)
    (path / "cam1.mkv").unlink()
    reading = Mock(wraps=size_of_clip)
    monkeypatch.setattr("morgs_mi.capture.layouts.nerfstudio.size_of_clip", reading)
    capture = load_capture(path)
    assert reading.call_count == 1
    assert [(camera.name, camera.width) for camera in capture.cameras] == [
        ("cam2", WIDTH),
        ("cam10", WIDTH),
    ]


def test_nerfstudio__names_keys_that_it_does_not_understand_once(tmp_path, caplog):
    def change(meta):
        meta.update(
            aabb_scale=16,
            scale=1,
            applied_transform=[],
            applied_scale=1.0,
            rolling_shutter=[0, 0, 1],
            test_filenames=[],
        )
        for frame in meta["frames"]:
            frame.update(sharpness=9.5, colmap_im_id=3, depth_file_path="d.png", k5=0.1)

    path = photos(tmp_path / "a", change=change)
    load_capture(path)
    assert caplog.messages == [
        f"{path / 'transforms.json'}: not understood and not used: k5, rolling_shutter, "
        "test_filenames."
    ]
