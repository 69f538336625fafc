"""Synthetic captures: their files, and the scenes that are refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import read_colmap
from morgs_mi.capture.truth import load_truth
from morgs_mi.extras.synth.disturbances import Disturbances
from morgs_mi.extras.synth.scene import Light, Object, Scene, load_scene
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize
from morgs_mi.extras.synth.textures import lights, textured
from morgs_mi.io.clip_readers import open_frames
from morgs_mi.platform.bounded import read_json
from morgs_mi.testing import assert_close

TINY = SynthConfig(cameras=2, frames=1, width=16, height=16, spp=1)


@pytest.mark.slow
def test_synthesize__writes_images_videos_truth_and_a_colmap_model(clip):
    metadata = read_json(clip / "capture.json")
    assert metadata["test_view"] == 0
    assert (metadata["fps"], metadata["num_frames"], metadata["seed"]) == (30.0, 3, 0)
    expected = load_scene("arm").rig.cameras(3, 64, 48)
    model = read_colmap(clip / "sparse" / "0")
    for ours, image in zip(expected, model.images, strict=True):
        assert_close(image.camera.viewmat, ours.viewmat, atol=1e-6)
        assert_allclose(image.camera.K, ours.K)
        assert image.name == f"{ours.name}.png"
        assert open_frames(clip / f"{ours.name}.mp4").num_frames == 3
        assert len(list((clip / "frames" / ours.name).glob("*.png"))) == 3
        assert len(list((clip / "truth" / ours.name).glob("*.exr"))) == 3


@pytest.mark.slow
def test_synthesize__colmap_points_lie_on_the_surface_within_their_noise(clip):
    points = read_colmap(clip / "sparse" / "0").points.astype(float)
    assert len(points) > 1000
    distances = []
    for camera in load_scene("arm").rig.cameras(3, 64, 48)[1:]:
        depth = load_truth(clip / "truth", camera.name, 0).depth
        pixels, z = camera.project(points)
        column, row = np.floor(np.clip(pixels, 0, (63, 47))).astype(int).T
        distances.append(np.abs(z - depth[row, column]) * camera.K[0, 0] / z)
    # Half a pixel of noise, and a surface that may slope by up to a pixel's width.
    median, most = np.percentile(np.min(distances, axis=0), (50, 95))
    assert median < 1
    assert most < 4


@pytest.mark.slow
def test_synthesize__replaces_a_capture_with_overwrite_and_no_other_files(tmp_path, clip):
    (tmp_path / ".git").mkdir()
    (tmp_path / "new" / "__MACOSX").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="not empty; choose another folder"):
        synthesize("spheres", tmp_path, TINY)
    # The last belongs to a fit; a recording may have one too.
    for content in ("{", "[]", '{"layout": "COLMAP"}'):
        (tmp_path / "capture.json").write_text(content)
        with pytest.raises(FileExistsError, match="is not a synthetic capture"):
            synthesize("spheres", tmp_path, TINY, overwrite=True)
    (tmp_path / "capture.json").unlink()
    synthesize("spheres", tmp_path / "new", replace(TINY, lossless=False))
    assert not (tmp_path / "new" / "frames").exists()
    assert load_capture(tmp_path / "new").num_frames == 1
    out = shutil.copytree(clip, tmp_path / "clip")
    counts = []
    synthesize("spheres", out, TINY, overwrite=True, progress=lambda *count: counts.append(count))
    assert read_json(out / "capture.json")["scene"] == "spheres"
    assert not (out / "cam02.mp4").exists()
    assert counts == [(1, 2), (2, 2)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".git", "clip", "new"]


@pytest.mark.slow
def test_synthesize__removes_its_output_after_a_failure(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("morgs_mi.extras.synth.synthesize.write_colmap", full)
    with pytest.raises(OSError, match=r"cannot write .*No space left"):
        synthesize("spheres", tmp_path / "clip", TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": 1}, "`cameras` must be at least 2, got 1"),
        ({"width": 63}, "`width` must be at least 2 and a multiple of 2, got 63"),
        ({"disturbances": Disturbances(rolling_shutter=1.5)}, "`rolling_shutter` must be at least"),
    ],
)
def test_synthesize__rejects_settings_out_of_range(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        synthesize("spheres", tmp_path / "clip", SynthConfig(**settings))


def test_synthesize__names_the_scenes(tmp_path):
    scenes = "'arm', 'flicker', 'random', 'spheres'"
    with pytest.raises(ValueError, match=f"a scene, got 'nowhere'; name one of .*{scenes}"):
        synthesize("nowhere", tmp_path / "clip")


def sphere(**entries):
    return {"type": "sphere", "bsdf": textured(np.full((2, 2, 3), 0.5, np.float32)), **entries}


def bitmap(file):
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": file}}


BALL = {"ball": Object({"ball": sphere()})}
WRONG_SCENES = {
    "mesh": (
        {"fox": Object({"body": {"type": "ply", "filename": "no.ply"}})},
        {},
        '"fox_body": .*"no.ply": file not found',
    ),
    "path": (
        {"a": Object({"b": sphere(bsdf=bitmap(Path(__file__)))})},
        {},
        "could not assign an object of type 'pathlib.PosixPath' to key 'filename'",
    ),
    "image": (
        {"a": Object({"b": sphere(bsdf=bitmap(__file__))})},
        lights(),
        'scene .mine.: Mitsuba cannot load it: .*"a_b.bsdf.reflectance"',
    ),
    "none": (
        {"a": Object({"b": sphere(radius=None)})},
        {},
        "object 'a', a_b: `radius` must have a value, got None",
    ),
    "no object": (
        {"a": sphere()},
        {},
        "object 'a': `it` must be a .*Object, got a dict",
    ),
    "names": (
        {"lamp": Object({"a": sphere()}, lambda t: np.eye(4))},
        lights(),
        r"light 'lamp': its names in Mitsuba must be its own, got \['lamp'\] twice",
    ),
    "later": (
        {"a": Object({"b": sphere()}, lambda t: np.diag([1 + t, 1, 1, 1]))},
        {},
        "its pose at 0.03333 s is not rigid: .*undo any scaling",
    ),
    "nan": (
        {"a": Object({"b": sphere()}, lambda t: np.nan * np.eye(4))},
        {},
        "its pose at 0 s is not rigid: the pose must be finite",
    ),
    "pose fails": (
        {"a": Object({"b": sphere()}, lambda t: {}["hinge"])},
        {},
        "object 'a': its pose at 0 s fails with KeyError: 'hinge'",
    ),
    "lamp pose": (
        BALL,
        {"p": Light({"type": "point"}, lambda t: np.eye(4))},
        "a lamp with a pose must be a shape",
    ),
    "black": (BALL, {}, "expected an emitter, got none, for black images; give it lights"),
    "nothing": ({}, lights(), "cam00 must see an object at 0 s, got none; move the objects"),
}


@pytest.mark.parametrize("case", WRONG_SCENES)
def test_synthesize__refuses_a_wrong_scene_before_rendering(tmp_path, case):
    objects, lamps, message = WRONG_SCENES[case]
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        synthesize(Scene("mine", objects, lamps), tmp_path / "clip", TINY)
    assert list(tmp_path.iterdir()) == []


def test_synthesize__warns_of_black_images(tmp_path, caplog):
    dark = Light({"type": "point", "position": [0, 0, 0]})
    synthesize(
        Scene("mine", {"a": Object({"b": sphere(center=[0, 0.8, 0])})}, {"inside": dark}),
        tmp_path / "clip",
        TINY,
    )
    assert "scene 'mine': cam00 is black at 0 s: no lamp reaches" in caplog.text


def test_synthesize__checks_the_memory_before_work_begins(tmp_path, monkeypatch):
    monkeypatch.setattr("morgs_mi.platform.memory.free_memory", lambda: 8e9)
    with pytest.raises(
        ValueError, match=r"fits in the 8\.0 GB of free .*, got images of 1000000000x1000000000 pix"
    ):
        synthesize("spheres", tmp_path / "a", replace(TINY, width=10**9, height=10**9))
