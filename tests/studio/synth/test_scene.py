"""Scenes: files with a mistake, and what the scenes of this package show."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.studio.synth.path_tracer import PathTracer
from morgs_mi.studio.synth.scene import load_scene
from tests.assertions import assert_close
from tests.studio.synth.frames import render_frame


@pytest.mark.slow
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
        "from morgs_mi.studio.synth.scene import Scene\n"
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
    pose = load_scene("spheres").objects[name].pose
    step = 1e-5
    for time in (0.0, 0.4, 2.0):
        here = pose(time)
        contact = here[:, 3] - [0, radius, 0, 0]
        point = np.linalg.inv(here) @ contact
        assert abs(contact[1]) < 1e-12
        assert np.linalg.norm((pose(time + step) - pose(time - step)) @ point) / (2 * step) < 1e-6
        assert np.linalg.norm(pose(time + step)[:3, 3] - here[:3, 3]) / step > 0.1


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_rig__test_view_is_at_the_centre():
    cameras = load_scene("spheres").rig.cameras(10, 320, 240)
    others = np.mean([camera.position for camera in cameras[1:]], axis=0)
    assert np.linalg.norm(cameras[0].position - others) < 0.5
    for camera in cameras:
        assert_close(camera.project(np.array([0, 0.8, 0]))[0], [160, 120], atol=1e-9)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("", r"scene.py: it must define `build\(seed\) -> Scene`"),
        ("build = 3", r"scene.py: it must define `build\(seed\) -> Scene`"),
        ("def build(): pass", r"scene.py: TypeError: build\(\) takes 0 positional arguments but 1"),
        (
            "def build(seed, size): pass",
            r"scene.py: TypeError: build\(\) missing 1 required positional argument: 'size'",
        ),
        ("def build(seed): pass", r"`build\(seed\) of .*scene.py` must be a .*Scene, got a None"),
        ("def build(seed): return {}", r"must be a .*Scene, got a dict; return Scene"),
        (
            "import nowhere\n",
            "scene.py, line 1: ModuleNotFoundError: No module named 'nowhere'; correct the scene",
        ),
        (
            "\ndef build(seed:\n",
            "scene.py, line 2: SyntaxError: '.' was never closed; correct the scene",
        ),
        (
            "import math\ndef build(seed):\n\n    return math.sqrt(-1)",
            "scene.py, line 4: ValueError: ",
        ),
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
