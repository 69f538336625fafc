"""Scenes: files with a mistake, and what the scenes of this package show."""

from pathlib import Path

import numpy as np
import pytest

from morgs_mi.extras.synth.scene import load_scene
from morgs_mi.testing import assert_close


def test_load_scene__accepts_dataclasses_with_postponed_annotations(tmp_path):
    (tmp_path / "own.py").write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass, field\n"
        "from morgs_mi.extras.synth.scene import Scene\n"
        "@dataclass\n"
        "class Part:\n"
        "    size: float = 1.0\n"
        "    below: list[Part] = field(default_factory=list)\n"
        "def build(seed):\n"
        "    return Scene(f'own{Part().size:g}', {}, {})\n"
    )
    assert load_scene(tmp_path / "own.py").name == "own1"


def test_rig__test_view_is_at_the_centre():
    cameras = load_scene("spheres").rig.cameras(10, 320, 240)
    positions = np.array([camera.position for camera in cameras])
    assert np.linalg.norm(positions[0] - positions[1:].mean(axis=0)) < 0.5
    for camera in cameras:
        assert_close(camera.project(np.array([0, 0.8, 0]))[0], [160, 120], atol=1e-9)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("build = 3", r"scene.py: it must define `build\(seed\) -> Scene`"),
        ("def build(): pass", r"scene.py: TypeError: build\(\) takes 0 positional arguments but 1"),
        ("def build(seed): return {}", r"must be a .*Scene, got a dict; return Scene"),
        (
            "\ndef build(seed:\n",
            r"scene.py: SyntaxError: '.' was never closed \(scene.py, line 2\); correct the scene",
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
