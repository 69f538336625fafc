"""A Mitsuba scene inserted into a stream."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi import open_stream
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.core.color_space import srgb_to_linear
from morgs_mi.export.frames import exr_channels
from morgs_mi.export.insert import inserted_channels, load_insert, render_inserted, selected
from morgs_mi.playback.player import render_stream
from tests.scenes.surfaces import camera, cloud

CARD = """
def build(frame, time):
    radiance = {"type": "rgb", "value": [0.25 * frame, time, 0.5]}
    glowing = {"bsdf": {"type": "diffuse", "reflectance": 0.0}, "emitter": {"type": "area", "radiance": radiance}}
    return {"card": {"type": "sphere", "center": [0, 0, -1], "radius": 0.3, **glowing}}
"""

XML = """<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><point name="center" x="0" y="0" z="-1"/><float name="radius" value="0.3"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.25, 0.0"/></bsdf></shape>
</scene>"""


@pytest.fixture
def stream(tmp_path: Path):
    with StreamWriter(tmp_path / "s.morgs", [camera()], 10) as writer:
        for frame in range(3):
            writer.write(keyframe_packet(cloud(0.5), frame))
    return open_stream(tmp_path / "s.morgs")


def test_render_inserted__shows_the_scene_of_each_frame(stream, tmp_path):
    (tmp_path / "card.py").write_text(CARD)
    images = dict(render_inserted(stream, camera(), load_insert(tmp_path / "card.py"), [0, 2], ("color", "alpha")))
    assert list(images) == [0, 2]
    for frame, expected in ((0, (0, 0, 0.735)), (2, (0.735, 0.485, 0.735))):
        np.testing.assert_allclose(images[frame]["color"][12, 16], expected, atol=2e-3)
        assert images[frame]["alpha"][12, 16, 0] == 1
    alone = dict(render_stream(stream, camera(), ("color",)))[0]["color"]
    np.testing.assert_allclose(images[0]["color"][:4], alone[:4], atol=2e-4)


def test_render_inserted__takes_shapes_lights_and_integrator_of_an_xml_file(stream, tmp_path):
    (tmp_path / "ball.xml").write_text(XML)
    build = load_insert(tmp_path / "ball.xml")
    images = dict(render_inserted(stream, camera(), build, [1], ("color",), samples=64))
    np.testing.assert_allclose(images[1]["color"][12, 16], (0.735, 0.537, 0), atol=0.05)


def test_render_inserted__lights_a_scene_without_emitters_by_the_stream(stream, tmp_path):
    (tmp_path / "ball.py").write_text('def build(frame, time):\n    return {"ball": {"type": "sphere"}}\n')
    images = dict(render_inserted(stream, camera(), load_insert(tmp_path / "ball.py"), [0]))
    assert images[0]["color"][12, 16].min() > 0.05


def test_render_inserted__layers_compose_to_the_image_where_surfaces_cover_nothing(stream, tmp_path):
    (tmp_path / "ball.py").write_text(
        "def build(frame, time):\n"
        '    return {"ball": {"type": "sphere", "center": [0, -0.5, -0.3], "radius": 0.4},\n'
        '            "sun": {"type": "directional", "direction": [0, 0.8, 0.8], "irradiance": 2.0}}\n'
    )
    channels = inserted_channels(stream)
    assert channels == ("color", "alpha", "motion", "depth", "splats", "surfaces", "shadow")
    images = dict(render_inserted(stream, camera(), load_insert(tmp_path / "ball.py"), [0], channels))[0]
    outside = images["surfaces"][..., 3] == 0
    assert images["shadow"].min() < 0.7 < images["shadow"].max() == pytest.approx(1)
    shadowed = images["splats"][..., :3] * images["shadow"]
    np.testing.assert_allclose(srgb_to_linear(images["color"])[outside], shadowed[outside], atol=1e-4)
    names = exr_channels(images)
    assert {"R", "A", "depth.Y", "splats.R", "surfaces.A", "shadow.R", "motion.X"} <= names.keys()


def test_selected__refuses_missing_frames(stream):
    assert selected(stream, (2, 0, 2)) == [0, 2]
    with pytest.raises(ValueError, match="the frames must be out of 0 to 2, got 7"):
        selected(stream, (1, 7))


BAD = {
    "missing.py": (None, "expected a scene to insert, FILE.xml or FILE.py, got none"),
    "a.json": ("{}", "FILE.xml or FILE.py, got '.json'"),
    "syntax.py": ("def build(:", "syntax.py, line 1: SyntaxError"),
    "empty.py": ("", r"expected a function `build\(frame, time\)`"),
    "none.py": ("def build(frame, time):\n    pass\n", "`build` must return a dict, got a NoneType"),
    "fails.py": ("def build(frame, time):\n    return 1 / 0\n", "fails.py, line 2: ZeroDivisionError"),
    "plugin.py": ("def build(frame, time):\n    return {'a': {'type': 'bal'}}\n", "The inserted scene: .*bal"),
    "bare.py": ("def build(frame, time):\n    return {}\n", "expected at least one shape, got none"),
    "broken.xml": ("<scene", "broken.xml: "),
}


@pytest.mark.parametrize("name", BAD)
def test_load_insert__refuses_bad_files(stream, tmp_path, name):
    text, message = BAD[name]
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        next(render_inserted(stream, camera(), load_insert(tmp_path / name)))
