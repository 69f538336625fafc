"""Every layout is found by the files in the folder and yields the same cameras and frames."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts import reader_registry
from morgs_mi.capture.layouts.calibration import CalibratedView, Calibration
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import MODELS
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.bounded import read_json
from morgs_mi.testing import assert_close
from tests.scenes import captures as layouts
from tests.scenes.cameras import moved
from tests.scenes.captures import (
    COUNT,
    FPS,
    HEIGHT,
    WIDTH,
    folder_per_camera,
    folder_per_frame,
    rig,
)

# Files store poses in text or float64; the focal length of a rig is near 50 px.
POSE_ABS = 1e-9
PIXEL_ABS = 1e-6


def assert_holds(capture, names, order, shift=0.0):
    """Check that camera j has name, pose, intrinsics and images of the rig's `order[j]`."""
    cameras = rig(names, shift)
    assert capture.names == tuple(names[i] for i in order)
    assert capture.num_frames == COUNT
    for camera, i in zip(capture.cameras, order, strict=True):
        assert_close(camera.viewmat, cameras[i].viewmat, atol=POSE_ABS)
        assert_close(camera.K, cameras[i].K, atol=PIXEL_ABS)
    for t, frame in enumerate(capture.frames()):
        assert [tuple(image[20, 30, :2]) for image in frame.images] == [(i, t) for i in order]


@pytest.mark.parametrize(
    "clips",
    [
        layouts.videos,
        lambda path, names: layouts.videos(path / "videos", names),
        folder_per_camera,
        lambda path, names: folder_per_camera(path / "images", names),
        lambda path, names: folder_per_camera(path, names, "images"),
        folder_per_frame,
        lambda path, names: folder_per_frame(path, names, "images"),
    ],
    ids=[
        "videos",
        "inner videos",
        "folders",
        "inner folders",
        "cam/images",
        "frames",
        "frames/images",
    ],
)
def test_poses_bounds__reads_meet_room(tmp_path, clips):
    assert_holds(
        load_capture(layouts.meet_room(tmp_path / "a", clips)),
        ("cam_0", "cam_2", "cam_10"),
        (0, 1, 2),
    )


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("shared", [True, False])
def test_colmap__reads_all_models(tmp_path, model, shared):
    names = ("cam10", "cam2", "cam1")
    focals, coefficients = MODELS[model]
    lens = [0.01 * (k + 1) for k in range(coefficients)]
    params = [[50.0 + i] * focals + [33.0, 20.0 + i, *lens] for i in range(3)]
    folder = tmp_path / "sparse" / "0"
    layouts.colmap_text(folder, rig(names), model, params, shared)
    layouts.videos(tmp_path, names)
    capture = load_capture(tmp_path)
    assert (capture.layout, capture.names) == ("COLMAP", ("cam1", "cam2", "cam10"))
    for view, i in zip(capture.metadata()["cameras"], (2, 1, 0), strict=True):
        number = 0 if shared else i
        assert_allclose(view["K"], [[50 + number, 0, 33], [0, 50 + number, 20 + number], [0, 0, 1]])
        assert view["lens"] == model
        assert_allclose(view["distortion"], lens)


def test_find_reader__follows_the_order_of_precedence(tmp_path):
    """COLMAP, Nerfstudio, Dynamic 3D Gaussians, poses_bounds; binary before text."""
    path = layouts.nerfstudio(tmp_path / "a")
    layouts.write_poses_bounds(path / "poses_bounds.npy", rig(("cam1", "cam2", "cam10")))
    assert load_capture(path).layout == "Nerfstudio"
    layouts.colmap_text(
        path / "sparse", rig(("cam1", "cam2")), "PINHOLE", [[50.0, 50, 31, 23]], shared=True
    )
    assert load_capture(path).names == ("cam1", "cam2")
    model = pycolmap.Reconstruction(str(path / "sparse"))
    model.cameras[1].params = [60.0, 60, 31, 23]
    model.write_binary(str(path / "sparse"))
    assert load_capture(path).cameras[0].K[0, 0] == 60
    meta = layouts.dynamic3dgs(tmp_path / "b")
    layouts.videos(meta, ("cam1",))
    layouts.write_poses_bounds(meta / "poses_bounds.npy", rig(("cam1",)))
    assert load_capture(meta).layout == "Dynamic 3D Gaussians"
    (meta / "transforms.json").write_text((path / "transforms.json").read_text())
    layouts.videos(meta, ("cam1", "cam2", "cam10"))
    assert load_capture(meta).layout == "Nerfstudio"


@pytest.mark.parametrize(
    ("build", "clip", "camera", "left"),
    [
        (layouts.colmap, "cam2.mkv", "cam2.png", ("cam1", "cam10")),
        (layouts.nerfstudio, "cam2.mkv", "./images/cam2.png", ("cam1", "cam10")),
        (layouts.dynamic3dgs, "ims/2/*", "2", ("1", "10")),
        (
            layouts.anipose,
            "trial_1-camB.mkv",
            "camB",
            ("trial_1-camA", "trial_1-camC"),
        ),
        (
            layouts.qualisys,
            "trial_Miqus_1_28984.mkv",
            "28984, 31111",
            ("trial_Miqus_0_26580", "trial_Miqus_2_29005"),
        ),
        (layouts.easymocap, "images/2/*", "2, 31", ("1", "10")),
    ],
)
def test_load_capture__leaves_out_cameras_without_clips_with_a_warning(
    tmp_path, caplog, build, clip, camera, left
):
    path = build(tmp_path / "a")
    for file in path.glob(clip):
        file.unlink()
    capture = load_capture(path)
    (warning,) = caplog.messages
    assert f"{camera}: left out." in warning or f"{camera} was found: left out." in warning
    assert capture.names == left
    whole = load_capture(build(tmp_path / "b"))
    expected = whole.cameras[::2]
    assert_close([c.viewmat for c in capture.cameras], [c.viewmat for c in expected], atol=POSE_ABS)


def test_load_capture__names_what_reads_a_fit(tmp_path):
    (tmp_path / "stream.morgs").touch()
    with pytest.raises(FileNotFoundError) as error:
        load_capture(tmp_path)
    assert str(error.value) == (
        f"{tmp_path}: expected a capture, found a fit; `morgs-mi eval {tmp_path}` scores it, "
        f"`morgs-mi view {tmp_path}` shows it."
    )
    with pytest.raises(
        FileNotFoundError, match=r"stream\.morgs: expected a capture folder, found a file"
    ):
        load_capture(tmp_path / "stream.morgs")


def edit(path, change, name="transforms.json"):
    meta = read_json(path / name)
    change(meta)
    (path / name).write_text(json.dumps(meta))


def test_nerfstudio__frames_override_the_keys_of_the_file(tmp_path):
    path = layouts.nerfstudio(tmp_path / "a")

    def change(meta):
        meta.update(fl_x=40.0, k1=0.02, k3=0.05, p2=0.03)
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del meta["frames"][1][key]
        meta["frames"][0].update(k1=0.07, camera_model="OPENCV_FISHEYE", k4=0.09)

    edit(path, change)
    capture = load_capture(path)
    assert_allclose(capture.cameras[1].K, [[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
    first, second, _ = capture.metadata()["cameras"]
    assert (first["lens"], first["distortion"]) == ("OPENCV_FISHEYE", [0.07, 0, 0.05, 0.09])
    assert (second["lens"], second["distortion"]) == (
        "FULL_OPENCV",
        [0.02, 0, 0, 0.03, 0.05, 0, 0, 0],
    )


def test_dynamic3dgs__reads_cameras(tmp_path):
    capture = load_capture(layouts.dynamic3dgs(tmp_path / "a"))
    assert (capture.layout, capture.test_views, capture.fps) == ("Dynamic 3D Gaussians", (), 30)
    assert_holds(capture, ("2", "1", "10"), (1, 0, 2), shift=3)
    assert_array_equal(capture.points, [[1, 2, 3]])
    assert_allclose(capture.point_colors, [[0.1, 0.2, 0.3]], rtol=1e-6)


def split_meta(path, **cameras):
    """Keep the `cameras` of `train_meta.json` in the files of these names."""
    meta = read_json(path / "train_meta.json")
    for name, members in cameras.items():
        picks = [[row.index(i) for i in members] for row in meta["cam_id"]]
        lists = {
            key: [[row[c] for c in pick] for row, pick in zip(meta[key], picks, strict=True)]
            for key in ("k", "w2c", "fn", "cam_id")
        }
        (path / f"{name}.json").write_text(json.dumps(meta | lists))
    return path


def test_dynamic3dgs__holds_out_all_test_cameras(tmp_path):
    path = split_meta(layouts.dynamic3dgs(tmp_path / "a"), train_meta=(1,), test_meta=(10, 2))
    calibration = reader_registry.find_reader(path).read(path)
    assert (calibration.names, calibration.held_out) == (("1", "2", "10"), ("2", "10"))
    assert load_capture(path).test_views == (1, 2)
    assert load_capture(path, test_view=None).test_views == ()
    assert load_capture(path, reading=ReadConfig(without=("2",))).test_views == (1,)
    shutil.rmtree(path / "ims" / "2")
    assert reader_registry.find_reader(path).read(path).held_out == ("10",)


JUNK = (
    "._{}",
    ".DS_Store",
    "Thumbs.db",
    "__MACOSX/{}",
    "__MACOSX/._{}",
    "@eaDir/{}/SYNOPHOTO_THUMB_XL.jpg",
)


# Layouts whose files of calibration are texts, or have some beside them.
CALIBRATED = [
    layouts.colmap,
    layouts.nerfstudio,
    layouts.dynamic3dgs,
    layouts.anipose,
    layouts.qualisys,
    layouts.easymocap,
]


@pytest.mark.parametrize(
    "build",
    [
        layouts.n3dv,
        lambda path: layouts.n3dv(path, clips=folder_per_camera),
        lambda path: layouts.n3dv(path, clips=folder_per_frame),
        *CALIBRATED,
    ],
)
def test_load_capture__ignores_what_systems_add(tmp_path, caplog, build):
    path = build(tmp_path / "a")
    names = load_capture(path).names
    caplog.clear()
    for file in [file for file in path.rglob("*") if file.is_file()]:
        for junk in JUNK:
            copy = file.parent / junk.format(file.name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(b"\0\5\x16\7" + bytes(99))
    capture = load_capture(path)
    assert capture.names == names
    assert [len(frame.images) for frame in capture.frames()] == [3] * COUNT
    assert "__MACOSX" not in caplog.text


@pytest.mark.parametrize("build", CALIBRATED)
def test_load_capture__reads_texts_of_windows(tmp_path, build):
    path = build(tmp_path / "a")
    (path / "capture.json").write_text('{"fps": 12}')
    unix_capture = load_capture(path)
    for file in [
        file for file in path.rglob("*") if file.suffix in (".txt", ".json", ".toml", ".yml")
    ]:
        declared = (
            "<?xml version='1.0' encoding='utf-8'?>\n" if file.name.endswith(".qca.txt") else ""
        )
        file.write_bytes((declared + file.read_text()).replace("\n", "\r\n").encode("utf-8-sig"))
    result = load_capture(path)
    assert (result.names, result.fps) == (unix_capture.names, 12)
    for camera, expected in zip(result.cameras, unix_capture.cameras, strict=True):
        assert_array_equal(camera.K, expected.K)
        assert_array_equal(camera.viewmat, expected.viewmat)


@pytest.mark.parametrize(
    ("file", "image"),
    [
        ("images/{camera}/{number}.png", "{}/1.png"),
        ("images/{camera}/{number}.png", "images/{}/1.png"),
        ("{camera}/{number}.png", "{}/3.png"),
        ("{camera}/images/{number}.png", "{}/images/2.png"),
        ("frames/{camera}/{number}.png", "./{}/1.png"),
        ("{frame}/{camera}.png", "0/{}.png"),
        ("{frame}/images/{camera}.png", "0/images/{}.png"),
    ],
)
@pytest.mark.parametrize("layout", ["COLMAP", "Nerfstudio"])
def test_match_clips__reads_cameras_and_frames_numbered_alike(tmp_path, layout, file, image):
    names = ("1", "2", "3")
    for i, name in enumerate(names):
        for t in range(COUNT):
            layouts.write_image(tmp_path / file.format(camera=name, number=t + 1, frame=t), i, t)
    views = [replace(camera, name=image.format(camera.name)) for camera in rig(names)]
    if layout == "COLMAP":
        write_colmap(tmp_path / "sparse/0", views)
    else:
        layouts.transforms(tmp_path, views)
    assert_holds(load_capture(tmp_path), names, (0, 1, 2))


def test_anipose__reads_the_names_of_pose2sim(tmp_path):
    path = layouts.anipose(
        tmp_path / "a", clips=lambda path, _: layouts.videos(path, ("A", "B", "C"))
    )
    file = path / "calibration.toml"
    file.write_text(re.sub('"cam(.)"', r'"int_\1_img"', file.read_text()))
    assert_holds(load_capture(path), ("A", "B", "C"), (0, 1, 2), shift=3)


@pytest.mark.parametrize("kind", ["txt", "ply", None])
def test_colmap__reads_points_of_several_files_or_none(tmp_path, kind):
    path = layouts.colmap(tmp_path / "a")
    file = path / "sparse/0/points3D.txt"
    if kind != "txt":
        file.unlink()
    if kind == "ply":
        vertex = np.array(
            [(0.1, 0.2, 0.3, 255, 0, 51)],
            [(axis, "f8") for axis in "xyz"] + [(band, "u1") for band in ("red", "green", "blue")],
        )
        PlyData([PlyElement.describe(vertex, "vertex")]).write(str(file.with_suffix(".ply")))
    capture = load_capture(path)
    count = 1 if kind else 0
    assert_close(capture.points, np.array([[0.1, 0.2, 0.3]])[:count], atol=1e-6)
    assert_close(capture.point_colors, np.array([[1, 0, 0.2]])[:count], atol=1e-6)


@pytest.mark.parametrize(
    "mask",
    [
        "frames/cam2/0000.png.png",
        "cam2/0000.png.png",
        "cam2/0003.png",
        "cam2.png.png",
        "cam2.png",
    ],
)
def test_colmap__uses_its_masks(tmp_path, mask):
    path = layouts.colmap(tmp_path / "a")
    folder_per_camera(path / "frames", ("cam1", "cam2", "cam10"))
    left = np.zeros((HEIGHT, WIDTH), np.uint8)
    left[:, : WIDTH // 2] = 255
    (path / "masks" / mask).parent.mkdir(parents=True)
    cv2.imwrite(str(path / "masks" / mask), left)
    capture = load_capture(path)
    assert capture.masks[::2] == (None, None)
    assert_array_equal(capture.masks[1], left > 0)


def test_masks__are_the_first_of_each_camera_and_others_are_named(tmp_path, caplog):
    path = layouts.colmap(tmp_path / "a")
    whole = np.full((HEIGHT, WIDTH), 255, np.uint8)
    for name, columns in (("cam2/0000.png.png", 9), ("cam2/0001.png.png", 30), ("cam7.png", 2)):
        file = path / "masks" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), np.where(np.arange(WIDTH) < columns, 0, whole))
    (path / "masks/cam2/._0000.png.png").write_bytes(b"added by macOS")
    capture = load_capture(path)
    assert capture.masks[::2] == (None, None)
    assert capture.masks[1].sum() == HEIGHT * (WIDTH - 9)
    assert caplog.messages == [
        f"{path / 'masks/cam7.png'}: not used, because no camera's image has its name, such as "
        "cam1.png.png."
    ]


# Easting, northing and height of a rig, m.
FAR = np.array([500000.0, 5300000.0, 120.0])


@pytest.mark.parametrize(
    "build",
    [
        layouts.anipose,
        layouts.colmap,
        layouts.dynamic3dgs,
        layouts.easymocap,
        layouts.n3dv,
        layouts.nerfstudio,
        layouts.qualisys,
    ],
)
def test_load_capture__of_a_far_rig_is_relative_to_an_origin(tmp_path, caplog, monkeypatch, build):
    near = load_capture(build(tmp_path / "near"))
    assert near.origin == (0, 0, 0)
    monkeypatch.setattr(layouts, "rig", lambda *args, **shift: moved(rig(*args, **shift), -FAR))
    far = load_capture(build(tmp_path / "far"))
    shift = np.array(far.origin) - FAR
    assert (np.abs(shift) < 10).all()
    for camera, expected in zip(far.cameras, moved(near.cameras, shift), strict=True):
        assert_close(camera.viewmat, expected.viewmat, atol=1e-6)
        assert_close(camera.near, expected.near, rtol=1e-6)
    assert "coordinates are relative to the origin (" in caplog.text


@pytest.mark.parametrize(("kind", "count"), [(np.float64, 1), (np.float32, 0)])
def test_centred__keeps_points_that_are_exact(tmp_path, kind, count):
    cameras = moved(rig(("cam1", "cam2", "cam3")), -FAR)
    points = (FAR[None] + 0.1).astype(kind)
    views = tuple(CalibratedView(camera, clip=tmp_path) for camera in cameras)
    calibration = Calibration(views, points, points).centred(tmp_path)
    assert_close(calibration.points, (points - calibration.origin)[:count], atol=1e-6)
    assert calibration.points.dtype == np.float32


def test_match_clips__refuses_far_cameras_that_move(tmp_path):
    path = layouts.nerfstudio(tmp_path / "a")
    cameras = rig(("cam1", "cam2"))
    layouts.transforms(path, [*moved(cameras, -FAR), *moved(cameras, 0.1 - FAR)])
    with pytest.raises(ValueError, match="cameras must not move"):
        load_capture(path)


UNREAD = {
    "Dynamic 3D Gaussians": (
        layouts.dynamic3dgs,
        "train_meta.json",
        ('{"w": ', '{"lens": 1, "w": '),
        "lens",
    ),
    "Anipose": (
        layouts.anipose,
        "calibration.toml",
        ("[cam_1]", "[extra]\na = 1\n[cam_1]\nskew = 2"),
        "extra, skew",
    ),
    "Qualisys": (
        layouts.qualisys,
        "rig.qca.txt",
        ('skew="0.0"', 'skew="0.1" radialDistortion4="1"'),
        "radial.*, skew",
    ),
    "capture.json": (layouts.n3dv, "capture.json", ("", '{"FPS": 3}'), "FPS"),
}


@pytest.mark.parametrize(("build", "file", "change", "names"), UNREAD.values(), ids=UNREAD)
def test_load_capture__names_what_it_does_not_understand_once(
    tmp_path, caplog, build, file, change, names
):
    path = build(tmp_path / "a")
    old, new = change
    text = (path / file).read_text() if old else ""
    (path / file).write_text(text.replace(old, new) if old else new)
    load_capture(path)
    (message,) = [text for text in caplog.messages if "not understood" in text]
    assert re.search(f"{file}: not understood and not used: {names}.$", message)


def test_at_clip_size__scales_the_intrinsics_of_smaller_clips(tmp_path, caplog):
    path = layouts.colmap(tmp_path / "a")
    small = np.full((HEIGHT // 2, WIDTH // 2, 3), 7, np.uint8)
    write_video(path / "frames" / "cam2", [small] * COUNT, FPS)
    capture = load_capture(path)
    assert not caplog.records
    assert [(c.width, c.height) for c in capture.cameras] == [(62, 46), (31, 23), (62, 46)]
    assert_close(capture.cameras[1].K[:2], rig(("a", "b"), shift=3)[1].K[:2] / 2, atol=PIXEL_ABS)


@pytest.mark.usefixtures("small_images")
def test_metadata__describes_how_frames_were_read(tmp_path):
    path = layouts.nerfstudio(tmp_path / "a")
    metadata = load_capture(path, downscale=2, test_view=1, max_frames=3).metadata()
    assert json.loads(json.dumps(metadata)) == metadata
    expected = {"layout": "Nerfstudio", "filter": "area", "downscale": 2, "frames": 3}
    assert metadata.items() >= expected.items()
    view = metadata["cameras"][2]
    expected = {"name": "cam10", "recorded_size": [62, 46], "size": [31, 23]}
    assert view.items() >= expected.items()
    assert load_capture(path).metadata()["filter"] == "none"
