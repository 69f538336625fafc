"""Synthetic captures: the files, and the ground truth against independent computations."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import read_colmap
from morgs_mi.capture.layouts.poses_bounds import read_poses_bounds
from morgs_mi.io.video import open_frames
from morgs_mi.synth.ground_truth import compute_ground_truth, load_tracks, load_truth, move_with_objects
from morgs_mi.synth.path_tracer import PathTracer
from morgs_mi.synth.scene import Light, Object, Scene, load_scene, translate
from morgs_mi.synth.synthesize import synthesize
from morgs_mi.synth.textures import lights, textured
from tests.assertions import assert_close

FPS = 30.0


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def render_frame(tracer: PathTracer, camera, frame: int):
    """Return the image and the ground truth of a frame."""
    time = frame / FPS
    tracer.set_time(time)
    points, ids = tracer.surface_points(camera)
    poses = [tracer.poses(time + step / FPS) for step in (0, -1, 1)]
    return tracer.render(camera, 16, frame), compute_ground_truth(camera, points, ids, *poses)


@pytest.fixture(scope="module")
def pair(tracer):
    camera = tracer.scene.rig.cameras(3, 320, 240)[1]
    return camera, render_frame(tracer, camera, 4), render_frame(tracer, camera, 5)


def test_synthesize__writes_the_layout_of_n3dv_with_a_colmap_model(clip):
    about = json.loads((clip / "capture.json").read_text())
    assert about["test_view"] == 0
    assert (about["fps"], about["num_frames"], about["seed"]) == (30.0, 3, 0)
    names = [f"cam{i:02d}" for i in range(3)]
    cameras, bounds = read_poses_bounds(clip / "poses_bounds.npy", names)
    model = read_colmap(clip / "sparse" / "0")
    expected = load_scene("arm").rig.cameras(3, 64, 48)
    for ours, theirs, colmaps in zip(expected, cameras, model.cameras, strict=True):
        assert_close(theirs.viewmat, ours.viewmat, atol=1e-6)
        assert_close(colmaps.viewmat, ours.viewmat, atol=1e-6)
        np.testing.assert_allclose(colmaps.K, ours.K)
        assert colmaps.name == f"{ours.name}.png"
    assert (bounds[:, 0] > 0).all()
    assert (bounds[:, 1] > bounds[:, 0]).all()
    for name in names:
        assert open_frames(clip / f"{name}.mp4").num_frames == 3
        assert len(list((clip / "frames" / name).glob("*.png"))) == 3
        assert len(list((clip / "truth" / name).glob("*.exr"))) == 3


def test_synthesize__lossless_frames_equal_the_rendered_images(clip):
    scene = load_scene("arm")
    tracer = PathTracer(scene)
    tracer.set_time(1 / FPS)
    noise = int(np.random.SeedSequence([0, 1, 1]).generate_state(1)[0])
    image = tracer.render(scene.rig.cameras(3, 64, 48)[1], 4, noise)
    stored = list(open_frames(clip / "frames" / "cam01").frames())[1]
    np.testing.assert_array_equal(stored, image)


def test_compute_ground_truth__motion_map_warps_the_previous_frame_onto_the_current_one(pair):
    _, (before, truth_before), (now, truth) = pair
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float32)
    source = grid - truth.motion
    # Visible in both frames: all neighbours of the source belong to the same object.
    corners = [np.floor(source).astype(int) + corner for corner in ((0, 0), (0, 1), (1, 0), (1, 1))]
    found = [truth_before.ids[np.clip(c[..., 1], 0, 239), np.clip(c[..., 0], 0, 319)] for c in corners]
    same = truth.mask & (np.stack(found) == truth.ids).all(axis=0)
    same = cv2.erode(same.astype(np.uint8), np.ones((3, 3))) > 0
    assert same.sum() > 5000

    def score(motion: np.ndarray) -> float:
        warped = cv2.remap(before, grid - motion, None, cv2.INTER_CUBIC)
        return psnr(warped[same], now[same])

    # Resampling and changes of shading limit the score to 31 dB, of which noise costs 0.2 dB (measured).
    assert score(truth.motion) > 29
    for wrong in (
        0 * truth.motion,
        -truth.motion,
        truth.motion + np.float32([0.5, 0]),
        truth.motion[..., ::-1],
    ):
        assert score(wrong) < score(truth.motion) - 1.5


def test_compute_ground_truth__only_moving_objects_have_motion(pair, tracer):
    _, _, (_, truth) = pair
    moves = np.array([item.pose is not None for item in tracer.scene.objects.values()])
    assert (truth.ids >= 0).all()
    np.testing.assert_array_equal(truth.mask, moves[truth.ids])
    assert (truth.motion[~moves[truth.ids]] == 0).all()
    assert 2 < np.linalg.norm(truth.motion[truth.mask], axis=-1).mean() < 6


def test_compute_ground_truth__first_frame_has_no_motion_and_the_mask_of_the_next_step(clip):
    first, second = (load_truth(clip / "truth", "cam01", frame) for frame in (0, 1))
    assert (first.motion == 0).all()
    assert first.mask.any()
    assert (first.mask == np.isin(first.ids, np.unique(second.ids[second.mask]))).all()


def test_load_tracks__tracks_reproject_to_the_motion_map(clip):
    tracks = load_tracks(clip / "truth")
    assert tracks.points.shape == (len(tracks.ids), 3, 3)
    compared = 0
    for camera in load_scene("arm").rig.cameras(3, 64, 48):
        for frame in (1, 2):
            truth = load_truth(clip / "truth", camera.name, frame)
            now, depth = camera.project(tracks.points[:, frame])
            before, _ = camera.project(tracks.points[:, frame - 1])
            # Points that were sampled at a pixel centre of this view and frame.
            col, row = (np.floor(now).astype(int) * [1, 1]).T
            at_centre = np.abs(now - np.floor(now) - 0.5).max(axis=1) < 1e-3
            at_centre &= (col >= 0) & (col < 64) & (row >= 0) & (row < 48)
            col, row = np.clip(col, 0, 63), np.clip(row, 0, 47)
            at_centre &= np.abs(depth - truth.depth[row, col]) < 1e-4
            np.testing.assert_array_equal(truth.ids[row, col][at_centre], tracks.ids[at_centre])
            assert_close((now - before)[at_centre], truth.motion[row, col][at_centre], atol=2e-3)
            compared += int((truth.mask[row, col] & at_centre).sum())
    assert compared > 100


def test_surface_points__agree_with_rays_of_the_mitsuba_sensor(tracer):
    camera = tracer.scene.rig.cameras(3, 64, 48)[2]
    K = camera.K.copy()
    K[:2, 2] += 7, -5
    camera = replace(camera, K=K)
    points, ids = tracer.surface_points(camera)
    y, x = np.mgrid[:48, :64].reshape(2, -1) + 0.5
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, mi.Point2f(x / 64, y / 48), 0)
    hit = tracer._scene.ray_intersect(mi.Ray3f(rays.o, rays.d))
    assert_close(np.array(hit.p).T.reshape(48, 64, 3)[5:-5, 5:-5], points[5:-5, 5:-5], atol=2e-3)
    pixels, depth = camera.project(points)
    assert_close(pixels, np.stack([x, y], axis=-1).reshape(48, 64, 2), atol=1e-3)
    poses = tracer.poses(0)
    np.testing.assert_allclose(compute_ground_truth(camera, points, ids, poses, None, poses).depth, depth, rtol=1e-6)


def test_compute_ground_truth__marks_pixels_without_a_surface():
    square = {"type": "rectangle"}
    scene = Scene("square", {"square": Object({"square": square}, lambda t: translate(t, 0.8, 0))}, {})
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(2, 64, 48)[0]
    points, ids = tracer.surface_points(camera)
    truth = compute_ground_truth(camera, points, ids, tracer.poses(0), None, tracer.poses(1))
    assert set(np.unique(truth.ids)) == {-1, 0}
    nothing = truth.ids < 0
    assert (truth.depth[nothing] == 0).all()
    assert not truth.mask[nothing].any()
    assert truth.mask[~nothing].all()


@pytest.mark.parametrize("radiance", [0.001, 0.18, 0.6, 3.0])
def test_render__returns_srgb_encoded_images(radiance):
    light = Light({"type": "constant", "radiance": {"type": "rgb", "value": radiance}})
    scene = Scene("sky", {}, {"sky": light})
    image = PathTracer(scene).render(scene.rig.cameras(2, 8, 8)[0], 1, 0)
    linear = min(radiance, 1.0)
    encoded = 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
    np.testing.assert_array_equal(image, np.uint8(round(255 * encoded)))


def test_render__sampling_noise_is_below_that_of_a_camera(tracer):
    camera = tracer.scene.rig.cameras(3, 96, 72)[1]
    tracer.set_time(0.1)
    # Measured: 41 dB at 320x240. A small image has larger pixels, with more texture in each.
    assert psnr(tracer.render(camera, 16, 1), tracer.render(camera, 1024, 2)) > 38


def test_synthesize__colmap_points_lie_on_the_surface_within_their_noise(clip):
    model = read_colmap(clip / "sparse" / "0")
    assert len(model.points) > 1000
    best = np.full(len(model.points), np.inf)
    for camera in load_scene("arm").rig.cameras(3, 64, 48)[1:]:
        depth = load_truth(clip / "truth", camera.name, 0).depth
        pixels, z = camera.project(model.points.astype(float))
        col, row = np.clip(np.floor(pixels).astype(int), 0, [63, 47]).T
        footprint = z / camera.K[0, 0]
        best = np.minimum(best, np.abs(z - depth[row, col]) / footprint)
    # Half a pixel of noise, and a surface that may slope by up to a pixel's width.
    assert np.median(best) < 1
    assert np.percentile(best, 95) < 4


@pytest.mark.parametrize("name", ["spheres", "arm", "thin", "flicker", "random"])
def test_load_scene__poses_are_rigid_and_repeatable(name):
    for item in load_scene(name).objects.values():
        if item.pose is not None:
            for time in (0.0, 0.31, 7.7):
                pose = item.pose(time)
                assert_close(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
                assert np.linalg.det(pose[:3, :3]) > 0
                np.testing.assert_array_equal(pose, item.pose(time))


def test_load_scene__accepts_dataclasses_with_postponed_annotations(tmp_path):
    (tmp_path / "own.py").write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass, field\n"
        "from morgs_mi.synth.scene import Scene\n"
        "@dataclass\n"
        "class Part:\n"
        "    size: float = 1.0\n"
        "    below: list[Part] = field(default_factory=list)\n"
        "def build(seed):\n"
        "    return Scene(f'own{Part().size:g}', {}, {})\n"
    )
    assert load_scene(tmp_path / "own.py").name == "own1"


@pytest.mark.parametrize(("name", "radius"), [("roller", 0.38), ("circler", 0.28)])
def test_spheres__balls_roll_without_slipping(name, radius):
    pose, step = load_scene("spheres").objects[name].pose, 1e-5
    for time in (0.0, 0.4, 2.0):
        here = pose(time)
        contact = here[:3, 3] - [0, radius, 0]
        ahead, behind = (
            move_with_objects(contact[None], np.zeros(1, int), [here], [pose(time + s)])[0] for s in (step, -step)
        )
        assert abs(contact[1]) < 1e-12
        assert np.linalg.norm(ahead - behind) / (2 * step) < 1e-6
        assert np.linalg.norm(pose(time + step)[:3, 3] - here[:3, 3]) / step > 0.1


def test_thin__objects_move_farther_than_their_width():
    tracer = PathTracer(load_scene("thin"))
    camera = tracer.scene.rig.cameras(3, 320, 240)[0]
    _, truth = render_frame(tracer, camera, 5)
    speed = np.linalg.norm(truth.motion, axis=-1)
    assert 0.03 < truth.mask.mean() < 0.08
    assert 8 < np.percentile(speed[truth.mask], 90) < 12
    # No moving object is wider than 10 pixels: an opening of 11 removes them.
    opened = cv2.morphologyEx(truth.mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((11, 11)))
    assert opened.sum() < 0.15 * truth.mask.sum()


def test_flicker__images_change_where_surfaces_are_static():
    tracer = PathTracer(load_scene("flicker"))
    camera = tracer.scene.rig.cameras(3, 160, 120)[0]
    images, truths = zip(*(render_frame(tracer, camera, frame) for frame in range(6)), strict=True)
    still = ~np.any([truth.mask for truth in truths], axis=0)
    assert still.mean() > 0.8
    assert all((truth.motion[still] == 0).all() for truth in truths)
    means = np.array([image[still].mean() for image in images])
    assert (np.abs(np.diff(means)) / means[1:] > 0.01).sum() >= 4
    # The lamp swings: the shading changes by more than a common factor.
    first, last = (image[still].mean(-1) / image[still].mean() for image in (images[0], images[-1]))
    assert np.percentile(np.abs(first - last), 95) > 0.05


def test_render__sensor_noise_has_the_requested_standard_deviation(tracer):
    tracer.set_time(0.0)
    camera = tracer.scene.rig.cameras(3, 160, 120)[0]
    clean = tracer.render(camera, 64, 0).astype(float)
    noisy, again = (tracer.render(camera, 64, 0, 0.02).astype(float) for _ in range(2))
    np.testing.assert_array_equal(noisy, again)
    inside = (clean > 30) & (clean < 225)
    # Rounding two images to bytes adds 1/6 to a variance of 26 squared grey levels.
    assert abs((noisy - clean)[inside].std() / (255 * 0.02) - 1) < 0.03
    assert abs((noisy - clean)[inside].mean()) < 0.15


def test_rig__test_view_is_at_the_centre():
    cameras = load_scene("spheres").rig.cameras(10, 320, 240)
    others = np.mean([camera.position for camera in cameras[1:]], axis=0)
    assert np.linalg.norm(cameras[0].position - others) < 0.5
    for camera in cameras:
        assert_close(camera.project(np.array([0, 0.8, 0]))[0], [160, 120], atol=1e-9)


def test_synthesize__rejects_a_non_empty_folder_and_replaces_a_capture_with_overwrite(tmp_path, clip):
    small = {"num_cameras": 2, "num_frames": 1, "width": 16, "height": 16, "spp": 1}
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="not empty; choose another folder"):
        synthesize("spheres", tmp_path, **small)
    for content in (None, "{", '{"layout": "COLMAP"}'):  # the last is that of a fit; a recording may have one too
        if content is not None:
            (tmp_path / "capture.json").write_text(content)
        with pytest.raises(FileExistsError, match="is not a synthetic capture"):
            synthesize("spheres", tmp_path, **small, overwrite=True)
    (tmp_path / "capture.json").unlink()
    out = shutil.copytree(clip, tmp_path / "clip")
    seen = []
    synthesize("spheres", out, **small, overwrite=True, progress=lambda done, total: seen.append((done, total)))
    assert json.loads((out / "capture.json").read_text())["scene"] == "spheres"
    assert not (out / "cam02.mp4").exists()
    assert seen == [(1, 2), (2, 2)]
    with pytest.raises(ValueError, match=f"expected an output outside of captures, .* in the capture {out}"):
        synthesize("spheres", out / "clip", **small)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip", "notes.txt"]


def test_synthesize__removes_its_output_after_a_failure(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("morgs_mi.synth.synthesize.write_colmap", full)
    with pytest.raises(OSError, match=r"cannot write .*the partial output was removed.*No space left"):
        synthesize("spheres", tmp_path / "clip", num_cameras=2, num_frames=1, width=16, height=16, spp=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_cameras": 1}, "`num_cameras` must be at least 2, got 1"),
        ({"num_frames": 0}, "`num_frames` must be at least 1, got 0"),
        ({"spp": 0}, "`spp` must be at least 1"),
        ({"seed": -1}, "`seed` must be at least 0"),
        ({"width": 63}, "must be even, got 63x240"),
        ({"fps": 0}, "`fps` must be positive"),
        ({"noise": -0.1}, "`noise` must be at least 0 and below 1, got -0.1"),
        ({"scene": "nowhere"}, "no scene 'nowhere'; name one of .*'arm', 'flicker', 'random', 'spheres', 'thin'"),
    ],
)
def test_synthesize__rejects_invalid_arguments(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        synthesize(**{"scene": "spheres", "out": tmp_path / "clip", **arguments})


def test_load_scene__accepts_any_file_path(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from morgs_mi.synth.scene import Scene\n\n\ndef build(seed):\n    return Scene('mine', {}, {})\n"
    )
    assert load_scene(tmp_path / "mine.py").name == "mine"


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("", r"scene.py must define `build\(seed\) -> Scene`"),
        ("build = 3", r"scene.py must define `build\(seed\) -> Scene`"),
        ("def build(): pass", r"`build` in .*scene.py must take the seed alone.*got `build\(\)`"),
        (
            "def build(seed, size): pass",
            r"must take the seed alone.*got `build\(seed, size\)`; give further parameters",
        ),
        ("def build(seed): pass", "`build` in .*scene.py must return a Scene, got None"),
        ("def build(seed): return {}", "must return a Scene, got a dict"),
        ("import nowhere\n", "scene.py, line 1: ModuleNotFoundError: No module named 'nowhere'; correct the scene"),
        ("\ndef build(seed:\n", "scene.py, line 2: SyntaxError: '.' was never closed; correct the scene"),
        ("import math\ndef build(seed):\n\n    return math.sqrt(-1)", "scene.py, line 4: ValueError: "),
        (
            "import mitsuba as mi\ndef build(seed):\n    return mi.Bitmap('no.png')",
            "scene.py, line 3: RuntimeError: .*no.png.*No such file",
        ),
    ],
)
def test_load_scene__names_the_file_and_line_of_a_mistake(tmp_path, monkeypatch, code, message):
    (tmp_path / "scene.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path / "scene.py", Path("scene.py")):
        with pytest.raises(ValueError, match=message) as error:
            load_scene(path)
        assert str(path) in str(error.value)


def sphere(**entries):
    return {"type": "sphere", "bsdf": textured(np.full((2, 2, 3), 0.5, np.float32)), **entries}


def bitmap(file):
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": file}}


def fails(time):
    raise KeyError("hinge")


BALL = {"ball": Object({"ball": sphere()})}
# Objects, lights and what is said about them.
WRONG_SCENES = {
    "mesh": (
        {"fox": Object({"body": {"type": "ply", "filename": "no.ply"}})},
        {},
        "object 'fox', shape 'body': its file no.ply does not exist; .*__file__",
    ),
    "texture": (
        {"a": Object({"b": sphere(bsdf=bitmap("no.png"))})},
        {},
        "shape 'b', bsdf, reflectance: its file no.png does not exist",
    ),
    "path": (
        {"a": Object({"b": sphere(bsdf=bitmap(Path(__file__)))})},
        {},
        "`filename` must be text, got a PosixPath; wrap it in str",
    ),
    "image": (
        {"a": Object({"b": sphere(bsdf=bitmap(__file__))})},
        lights(),
        'scene .mine.: Mitsuba cannot load it: .*"a_b.bsdf.reflectance"',
    ),
    "plugin": ({"a": Object({"b": {"type": "spere"}})}, lights(), 'Mitsuba cannot load it: .*"a_b".*"spere"'),
    "no dictionary": (
        {"a": Object({"b": None})},
        {},
        "shape 'b': expected a Mitsuba dictionary with a `type`, got None",
    ),
    "none": ({"a": Object({"b": sphere(radius=None)})}, {}, "shape 'b': `radius` must have a value, got None"),
    "no object": ({"a": sphere()}, {}, r"object 'a': expected Object\(...\), got a value of type dict"),
    "no light": (BALL, {"lamp": sphere()}, r"light 'lamp': expected Light\(...\), got a value of type dict"),
    "names": (
        {"lamp": Object({"a": sphere()}, lambda t: np.eye(4))},
        lights(),
        "light 'lamp': the name 'lamp' is used twice",
    ),
    "scaled": (
        {"a": Object({"b": sphere()}, lambda t: 2 * np.eye(4))},
        {},
        "object 'a': its pose at 0 s is not rigid: .*undo any scaling",
    ),
    "later": (
        {"a": Object({"b": sphere()}, lambda t: np.diag([1 + t, 1, 1, 1]))},
        {},
        "its pose at 0.03333 s is not rigid",
    ),
    "shape": (
        {"a": Object({"b": sphere()}, lambda t: np.eye(3))},
        {},
        r"must be a finite matrix \[4, 4\], got the shape \(3, 3\)",
    ),
    "nan": ({"a": Object({"b": sphere()}, lambda t: np.nan * np.eye(4))}, {}, "must be a finite matrix .*, got NaN"),
    "pose fails": (
        {"a": Object({"b": sphere()}, fails)},
        {},
        "object 'a': its pose at 0 s fails with KeyError: 'hinge'",
    ),
    "lamp pose": (BALL, {"p": Light({"type": "point"}, lambda t: np.eye(4))}, "a lamp with a pose must be a shape"),
    "black": (BALL, {}, "it has no emitter, so its images would be black; give it lights"),
    "nothing": ({}, lights(), "cam00 sees no object at 0 s; move the objects"),
}


@pytest.mark.parametrize("case", WRONG_SCENES)
def test_synthesize__refuses_a_wrong_scene_before_rendering(tmp_path, case):
    objects, lamps, message = WRONG_SCENES[case]
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        synthesize(Scene("mine", objects, lamps), tmp_path / "clip", num_cameras=2, num_frames=1, width=16, height=16)
    assert list(tmp_path.iterdir()) == []


def test_synthesize__warns_of_black_images(tmp_path, caplog):
    dark = Light({"type": "point", "position": [0, 0, 0]})
    size = {"num_cameras": 2, "num_frames": 1, "width": 16, "height": 16, "spp": 1}
    synthesize(
        Scene("mine", {"a": Object({"b": sphere(center=[0, 0.8, 0])})}, {"inside": dark}), tmp_path / "clip", **size
    )
    assert "scene 'mine': cam00 is black at 0 s: no lamp reaches" in caplog.text


def test_synthesize__writes_videos_that_browsers_play_beside_the_lossless_frames(clip):
    video = cv2.VideoCapture(str(clip / "cam01.mp4"))
    assert int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little") == b"VP90"
    played, stored = (np.array(list(open_frames(clip / name).frames())) for name in ("cam01.mp4", "frames/cam01"))
    assert played.shape == stored.shape
    assert psnr(played, stored) > 25
    np.testing.assert_array_equal(np.array([f.images[1] for f in load_capture(clip).frames()]), stored)


def test_synthesize__without_lossless_frames_records_the_videos(tmp_path):
    size = {"num_cameras": 2, "num_frames": 2, "width": 32, "height": 32, "spp": 1}
    out = synthesize("spheres", tmp_path / "clip", **size, lossless=False)
    assert not (out / "frames").exists()
    played = np.array(list(open_frames(out / "cam01.mp4").frames()))
    np.testing.assert_array_equal(np.array([f.images[1] for f in load_capture(out).frames()]), played)


def test_synthesize__writes_lossless_videos_where_opencv_has_no_playable_encoder(tmp_path, monkeypatch):
    monkeypatch.setattr("morgs_mi.synth.synthesize.playable_format", lambda: (".mkv", "FFV1"))
    size = {"num_cameras": 2, "num_frames": 1, "width": 16, "height": 16, "spp": 1}
    out = synthesize("spheres", tmp_path / "clip", **size)
    played, stored = (np.array(list(open_frames(out / name).frames())) for name in ("cam01.mkv", "frames/cam01"))
    np.testing.assert_array_equal(played, stored)
