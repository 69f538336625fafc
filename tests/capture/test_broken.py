"""Broken captures in every layout, and their messages."""

import os
import re
import shutil

import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.video_writer import write_video
from tests.capture.layouts.test_layouts import edit
from tests.scenes import captures as layouts

# ---- damage to clips
# -------------------------------------------------------------------------------------


def missing(name):
    return lambda path: (path / name).unlink()


def pipe(name):
    """Put a named pipe, from which nothing ever comes, in the place of a file."""

    def damage(path):
        (path / name).unlink(missing_ok=True)
        os.mkfifo(path / name)

    return damage


def cut(name, size):
    """Cut a file after some bytes."""
    return lambda path: (path / name).write_bytes((path / name).read_bytes()[:size])


def renamed(path):
    for i, clip in enumerate(sorted(path.glob("*.mkv"))):
        clip.rename(path / f"left{i}.mkv")


# ---- damage to calibrations
# ------------------------------------------------------------------------------


def replace(name, old, new):
    def damage(path):
        text = (path / name).read_text()
        assert old in text
        (path / name).write_text(text.replace(old, new, 1))

    return damage


def in_json(name):
    return lambda change: lambda path: edit(path, change, name)


transforms = in_json("transforms.json")
meta = in_json("train_meta.json")


def pose(index, scale):
    """Scale the first column of a camera's rotation."""

    def change(values):
        for row in values["frames"][index]["transform_matrix"][:3]:
            row[0] *= scale

    return change


def moving(values):
    values["w2c"][2][values["cam_id"][2].index(10)][0][3] += 0.5


# By kind of damage: the damage, the message, and how the capture is read.
POSES_BOUNDS = {
    "no file": (
        missing("poses_bounds.npy"),
        "expected a calibration .*poses_bounds.npy.* run `morgs-mi calibrate`",
    ),
    "pipe beside": (
        pipe("capture.json"),
        "capture.json: expected a file, got a folder, a pipe or a device; name a file",
    ),
    "far offset": (
        lambda path: None,
        "no timestamp in common, cam00 0.00 to 0.16 s, cam02 -0.36 to -0.20",
        ReadConfig(offset={"cam02": 9}),
    ),
    "gaps and no clip": (
        cut("cam00.mkv", 0),
        "cam00.mkv: expected a video, got 0 bytes",
        ReadConfig(gaps=True),
    ),
    # The headers alone.
    "clip of no frames": (cut("cam00.mkv", 600), "cam00.mkv: .*no frame can be decoded"),
}
BY_FRAME = {
    "pipe": (pipe("frame000002/cam_2.png"), "frame000002/cam_2.png: expected an image, found none"),
    "no image at all": (
        lambda path: [file.write_bytes(b"") for file in path.glob("frame*/cam_2.png")],
        "frame000000/cam_2.png: expected an image, got 0 bytes",
        ReadConfig(gaps=True),
    ),
    "no frame": (
        lambda path: (path / "frame000001").rename(path / "frame000007"),
        "the frames must be numbered without gaps, got frame000000 followed by frame000002",
    ),
}
COLMAP = {
    "pipe": (
        pipe("sparse/0/images.txt"),
        "images.txt: expected a file of a COLMAP model, found none",
    ),
    "other clips": (
        renamed,
        r"clips named after its cameras cam1.png, cam2.png, cam10.png, found left0, left1, left2",
    ),
    "huge place": (
        replace("sparse/0/images.txt", " 1 cam1.png", "e308 1 cam1.png"),
        "images.txt, image 'cam1.png': .* the pose must be finite, with numbers of at most",
    ),
    "no clips": (
        lambda path: [clip.unlink() for clip in path.glob("*.mkv")],
        r"expected videos \(.mp4",
    ),
    "other size": (
        lambda path: write_video(path / "cam2.mkv", layouts.frames(1, width=60), layouts.FPS),
        "cam2.mkv: expected 62x46, the calibrated size of cam2, or a scaled .*, got 60x46",
    ),
    "moving camera": (
        replace("sparse/0/images.txt", "cam2.png", "cam1/0001.png"),
        "cameras must not move, but 'cam1.png' and 'cam1/0001.png', both of cam1, have",
    ),
    "infinite point": (
        replace("sparse/0/points3D.txt", "1 0.1 ", "1 inf "),
        "`points` must be finite and at most .*, got .inf",
    ),
}
NERFSTUDIO = {
    "no frames": (
        transforms(lambda m: m.update(frames=[])),
        "transforms.json: `frames` must have an entry for each camera, got none; export it again",
    ),
    "unnamed": (
        transforms(lambda m: m["frames"][1].pop("file_path")),
        "frame 1: `file_path` must name a file, got None",
    ),
    "no size": (
        transforms(lambda m: m.update(w="62")),
        r"frame 0 .*: `w` must be a number in \[-1e12, 1e12\], got '62'",
    ),
    "unknown model": (
        transforms(lambda m: m.update(camera_model="EQUIRECTANGULAR")),
        "got 'EQUIRECTANGULAR' with 0; undist",
    ),
    "list": (
        lambda path: (path / "transforms.json").write_text("[]"),
        r"transforms.json: expected an object, got \[\]",
    ),
    "neither size nor image": (
        lambda path: edit(
            path,
            lambda m: [m.pop("w"), *(f.update(file_path="a.png") for f in m["frames"])],
        ),
        "expected clips named after its cameras a.png, a.png, a.png, found cam1, cam2, cam10",
    ),
    "angle": (
        transforms(lambda m: [m.update(camera_angle_x=0), *(f.pop("fl_x") for f in m["frames"])]),
        r"frame 0 .*: `camera_angle_x` must be a number in \(0, 3.14159\), got 0",
    ),
    "moving camera": (
        transforms(lambda m: [f.update(time=i / 2) for i, f in enumerate(m["frames"])]),
        "`time` must have as many values as each camera has images, 1, because cameras are fixed, "
        "got 3; record by fixed cameras",
    ),
    "large size": (
        transforms(lambda m: m.update(w=1e11, h=1e10)),
        "expected 1.*, the calibrated size of cam1",
    ),
    "k4": (
        transforms(lambda m: m.update(k4=0.1)),
        "with a `k4` of 0 one of .*, got 'OPENCV' with 0.1; undist",
    ),
    "no rotation": (
        transforms(pose(0, 1.5)),
        "frame 0 .*cam1.png.: .*: the axes must be a right-handed",
    ),
    "no pose": (
        transforms(lambda m: m["frames"][0].pop("transform_matrix")),
        "frame 0 .*: `transform_matrix`: the pose must be a matrix",
    ),
    "short row": (
        transforms(lambda m: m["frames"][0]["transform_matrix"][0].pop()),
        "frame 0 .*: `transform_matrix` must be an array of real numbers, got .*; convert",
    ),
    "no points": (
        transforms(lambda m: m.update(ply_file_path="a.ply")),
        "a.ply: expected the points' PLY file, found",
    ),
}
DYNAMIC3DGS = {
    "no image": (missing("ims/10/000002.png"), "ims/10/000002.png: expected an image, found none"),
    "no key": (
        meta(lambda m: m.pop("w2c")),
        "train_meta.json: expected the keys .*, got none of w2c",
    ),
    "fewer poses": (
        meta(lambda m: m["w2c"].pop()),
        r"as many cameras in every frame, got the shapes \(4, 3\), \(4, 3\), \(3, 3\), ",
    ),
    "no frames": (
        meta(lambda m: m.update(fn=[])),
        r"as many cameras in every frame, got the shapes \(4, 3\), \(0,\), ",
    ),
    "other camera": (
        meta(lambda m: m["cam_id"][1].__setitem__(0, 7)),
        "`cam_id` must name each camera of .*, got another camera in frame 1",
    ),
    "long pose": (
        meta(lambda m: m["w2c"][1][0][0].__setitem__(0, 10**400)),
        "train_meta.json: `w2c` must be an array of real numbers",
    ),
    "moving camera": (
        meta(moving),
        "camera 10: the pose in frame 2 must equal that in frame 0, .* moving cameras are not",
    ),
    "broken points": (cut("init_pt_cld.npz", 300), "init_pt_cld.npz: expected an array `data`"),
}
ANIPOSE = {
    "no pose": (
        replace("calibration.toml", "translation", "translate"),
        r"\[cam_0\]: `translation` must be .* got none",
    ),
    "word": (
        replace("calibration.toml", "rotation = [", 'rotation = ["a", '),
        r"`rotation` must be finite numbers \[3\]",
    ),
    "three coefficients": (
        replace("calibration.toml", "distortions = [0.0, 0.0, ", "distortions = ["),
        r"\[cam_0\]: `distortions` must be finite numbers \[4\] or \[5\] or \[8\] of at most "
        r"1e\+12, got",
    ),
    "half a pixel": (
        replace("calibration.toml", "size = [62.0", "size = [62.5"),
        "`size` must be whole pixels",
    ),
    "name": (
        replace("calibration.toml", '"camA"', "[]"),
        r"\[cam_0\]: `name` must be a text, got \[\]",
    ),
}
QUALISYS = {
    "broken file": (cut("rig.qca.txt", 300), "rig.qca.txt: expected XML, got a broken file"),
    "many elements": (
        lambda path: (path / "rig.qca.txt").write_text("<a>" + "<b/>" * 2_000_000 + "</a>"),
        "got a claim of 2000002 elements and attributes",
    ),
    "document type": (
        replace("rig.qca.txt", "<calibration>", "<!DOCTYPE a><calibration>"),
        "declares a document type",
    ),
    "no transform": (
        replace("rig.qca.txt", "transform", "moved"),
        "'26580': expected an element `transform`, found none",
    ),
    "no attribute": (
        replace("rig.qca.txt", " y=", " why="),
        "`y` of `transform` must be a finite number .*, got none",
    ),
    "no serial": (
        replace("rig.qca.txt", 'serial="26580"', ""),
        "every `camera` must have a `serial`, got one without",
    ),
    "two files": (
        lambda path: (path / "old.qca.txt").write_text((path / "rig.qca.txt").read_text()),
        r"expected one file \*.qca.txt, got old.qca.txt, rig.qca.txt; keep",
    ),
}
EASYMOCAP = {
    "no intrinsics": (missing("intri.yml"), "intri.yml: expected the intrinsics, found none; copy"),
    "broken file": (cut("extri.yml", 300), "extri.yml: expected OpenCV's YAML, got a broken file"),
    "no map": (
        lambda path: (path / "intri.yml").write_text("%YAML:1.0\n---\n- 1\n"),
        "intri.yml: expected OpenCV's YAML, got a broken file; export it again",
    ),
    "nested lists": (
        lambda path: (path / "intri.yml").write_text("%YAML:1.0\n---\na: " + "[" * 90_000),
        "intri.yml: expected at most 10000 lists, got 90000",
    ),
    "no poses": (
        lambda path: (path / "extri.yml").write_text("%YAML:1.0\n---\na: 1\n"),
        "extri.yml: expected `T_NN` for each camera NN, got none; export it again",
    ),
    "no camera": (
        replace("intri.yml", "K_2:", "P_2:"),
        "intri.yml: `K_2` must be a matrix of 9 finite numbers, got none that can be read; calib",
    ),
    "short matrix": (
        replace("extri.yml", ", -0.44721359549995793 ]", " ]"),
        "extri.yml: `Rot_1` must be a matrix of 9 finite numbers, got none",
    ),
    "no rotation": (
        replace("extri.yml", "data: [ 0., 1.", "data: [ 2., 1."),
        "extri.yml, camera 1: the axes must be a right-handed orthonormal frame",
    ),
}
LAYOUTS = {
    "poses_bounds": (layouts.n3dv, POSES_BOUNDS),
    "by frame": (lambda path: layouts.meet_room(path, layouts.folder_per_frame), BY_FRAME),
    "COLMAP": (layouts.colmap, COLMAP),
    "Nerfstudio": (layouts.nerfstudio, NERFSTUDIO),
    "Dynamic 3D Gaussians": (layouts.dynamic3dgs, DYNAMIC3DGS),
    "Anipose": (layouts.anipose, ANIPOSE),
    "Qualisys": (layouts.qualisys, QUALISYS),
    "EasyMocap": (layouts.easymocap, EASYMOCAP),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_load_capture__refuses_a_broken_capture(tmp_path, layout):
    build, table = LAYOUTS[layout]
    whole = build(tmp_path / "whole")
    mistakes = []
    for kind, (damage, message, *reading) in table.items():
        path = shutil.copytree(whole, tmp_path / kind)
        damage(path)
        try:
            next(load_capture(path, reading=reading[0] if reading else None).frames(2))
        except (ValueError, FileNotFoundError) as error:
            if re.search(message, str(error)) and "\n" not in str(error):
                continue
            mistakes.append((kind, error))
        else:
            mistakes.append((kind, "none"))
    assert mistakes == []
