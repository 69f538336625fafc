"""Which files of a capture are the clips of its cameras, and which other ones are named."""

import json
import shutil
import unicodedata
from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.clips import clips_by_camera
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.video_writer import write_video
from tests.capture.layouts.test_layouts import assert_holds
from tests.scenes import captures as layouts
from tests.scenes.captures import COUNT, FPS, folder_per_camera, rig


def test_clips__refuse_files_that_differ_in_their_suffixes(tmp_path):
    path = layouts.colmap(tmp_path / "a")
    shutil.copy(path / "cam2.mkv", path / "cam2.mov")
    with pytest.raises(
        ValueError,
        match=r"expected one file of each name, got cam2.mkv and cam2.mov",
    ):
        load_capture(path)


def test_clips_by_camera__names_clips_in_several_folders(tmp_path, caplog):
    for folder in ("depth", "images", "images_2", "rgb"):
        folder_per_camera(tmp_path / folder, ("cam1", "cam2"))
    assert clips_by_camera(tmp_path) == {
        name: tmp_path / "images" / name for name in ("cam1", "cam2")
    }
    assert "clips such as images/cam1 are used, not rgb/cam1" in caplog.text
    assert "images_2" not in caplog.text


# Folders of a recording and of what depth cameras and other tools add, with {} for the camera.
COLORS = {
    "kinds of each camera": ("{}/color", ("{}/depth", "{}/infrared")),
    "cameras of each kind": ("rgb/{}", ("depth/{}", "infrared/{}", "normal/{}")),
    "masks in the camera's folder": ("{}", ("{}/mask",)),
}


@pytest.mark.parametrize("kind", COLORS)
def test_find_clips__reads_colors_alone(tmp_path, kind):
    colors, others = COLORS[kind]
    names = ("cam1", "cam2", "cam3")
    for folder in others:
        for name in names:
            write_video(tmp_path / folder.format(name), layouts.frames(9), FPS)
    for i, name in enumerate(names):
        for t in range(COUNT):
            layouts.write_image(tmp_path / colors.format(name) / f"{t:04d}.png", i, t)
    write_colmap(tmp_path / "sparse/0", rig(names))
    assert_holds(load_capture(tmp_path), names, (0, 1, 2))


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (("{}/GX010042.mkv", "{}/GX020042.mkv"), "found cam1_GX010042, .*: join the chapters"),
        (("left/{}.mkv", "right/{}.mkv"), "found left_cam1, left_cam2, .* right_cam2"),
        (("{}/0.png", "{}/0.jpg"), "cam1: expected one file of each name, got 0.jpg and 0.png"),
    ],
)
def test_load_capture__refuses_several_clips_of_a_camera(tmp_path, caplog, files, names):
    for file in files:
        for camera in ("cam1", "cam2"):
            path = tmp_path / file.format(camera)
            if path.suffix == ".mkv":
                write_video(path, layouts.frames(0), FPS)
            else:
                layouts.write_image(path, 0, 0)
    write_colmap(tmp_path / "sparse/0", rig(("cam1", "cam2")))
    with pytest.raises((ValueError, FileNotFoundError), match=names):
        load_capture(tmp_path)
    assert not caplog.text


@pytest.mark.parametrize("inner", ["", "images"])
def test_load_capture__compares_names_in_one_unicode_form(tmp_path, inner):
    """Files copied from macOS have decomposed names."""
    names = ("Mïtte", "Nörd", "Süd")
    for i, name in enumerate(names):
        folder = unicodedata.normalize("NFD" if i else "NFC", name)
        write_video(tmp_path / folder / inner, layouts.frames(i), FPS)
    write_colmap(tmp_path / "sparse/0", rig(names))
    settings = {"test_view": unicodedata.normalize("NFD", "Nörd"), "readout": {"Su\u0308d": 0.5}}
    (tmp_path / "capture.json").write_text(json.dumps(settings))
    capture = load_capture(tmp_path)
    assert capture.names == names
    assert capture.test_views == (1,)
    assert capture.cameras[2].readout == 0.5
    offset = ReadConfig(offset={"Su\u0308d": 1}, without=("No\u0308rd",))
    capture = load_capture(tmp_path, reading=offset)
    assert [image[20, 30, 1] for image in next(capture.frames()).images] == [0, 1]


# Clips and photos in folders of folders, the images that a calibration names, and the cameras.
RIGS = {
    "rigs": (
        ("images/rig1/cam01/0000.png", "images/rig1/cam02/0000.png", "images/rig2/cam01/0000.png"),
        ("rig1_cam01", "rig1_cam02", "rig2_cam01"),
    ),
    "one rig": (
        ("images/rig/a/0.png", "images/rig/b/0.png", "images/rig/c/0.png"),
        ("a", "b", "c"),
    ),
    "photos": (
        ("images/day/1.png", "images/day/2.png", "images/night/1.png"),
        ("day_1", "day_2", "night_1"),
    ),
    "memory cards that count on": (
        ("videos/cam01/GX010042.mkv", "videos/cam02/GX010043.mkv", "videos/cam03/GX010044.mkv"),
        ("cam01", "cam02", "cam03"),
    ),
}


@pytest.mark.parametrize(("files", "names"), RIGS.values(), ids=RIGS)
def test_match_clips__reads_folders_of_folders(tmp_path, files, names):
    for i, file in enumerate(files):
        if file.endswith(".png"):
            layouts.write_image(tmp_path / file, i, 0)
        else:
            write_video(tmp_path / file, layouts.frames(i), FPS)
    images = (name.removeprefix("images/").removeprefix("videos/") for name in files)
    write_colmap(tmp_path / "sparse/0", rig(tuple(images)))
    capture = load_capture(tmp_path)
    assert capture.names == names
    assert [image[20, 30, 0] for image in next(capture.frames()).images] == [0, 1, 2]


@pytest.mark.parametrize("count", [COUNT, 1])
def test_match_clips__of_photos_with_equal_poses_reads_frames(tmp_path, count):
    """One photo of each camera is a static scene."""
    cameras = rig(("a", "b"), shift=3)
    for i, t in np.ndindex(len(cameras), count):
        layouts.write_image(tmp_path / f"images/{'ab'[i]}{t:03}.png", i, t)
    views = [replace(c, name=f"{c.name}{t:03}.png") for t in range(count) for c in cameras]
    write_colmap(tmp_path / "sparse/0", views)
    capture = load_capture(tmp_path)
    assert (capture.names, capture.num_frames) == (("a000", "b000"), count)
    for t, frame in enumerate(capture.frames()):
        assert [tuple(image[20, 30, :2]) for image in frame.images] == [(0, t), (1, t)]
    assert "static scene" not in "".join(capture.notes) or count == 1


def test_match_clips__leaves_videos_with_equal_poses_apart(tmp_path):
    """`info` reports them as a mistake in the calibration."""
    names = ("cam1", "cam2")
    layouts.videos(tmp_path, names)
    (camera,) = rig(("cam1",))
    write_colmap(tmp_path / "sparse/0", [replace(camera, name=name) for name in names])
    assert load_capture(tmp_path).names == names


@pytest.mark.parametrize(
    ("build", "clip", "without"),
    [(layouts.colmap, "cam3.mkv", "cam3"), (layouts.dynamic3dgs, "", "2")],
)
def test_without__takes_names_of_clips_and_cameras_that_are_left_out(
    tmp_path, build, clip, without
):
    path = build(tmp_path / "a")
    if clip:
        shutil.copy(path / "cam1.mkv", path / clip)
    else:
        shutil.rmtree(path / "ims" / without)
    names = load_capture(path).names
    assert load_capture(path, reading=ReadConfig(without=(without,))).names == names
    rest = load_capture(path, reading=ReadConfig(without=(without, names[0]))).names
    assert rest == names[1:]
