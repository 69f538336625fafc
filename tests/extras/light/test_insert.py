"""A Mitsuba scene inserted into a stream."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import open_stream
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.core.color_space import TRANSFER, decode_light
from morgs_mi.extras.light.insert import (
    InsertConfig,
    inserted_channels,
    load_insert,
    render_inserted,
    selected,
)
from morgs_mi.io.exr import read_exr
from morgs_mi.playback.export.frames import write_images
from morgs_mi.playback.player import render_stream
from tests.playback.test_light import STOPS, written
from tests.scenes.surfaces import camera, cloud

CARD = """
def build(frame, time):
    radiance = {"type": "rgb", "value": [0.25 * frame, time, 0.5]}
    black = {"type": "diffuse", "reflectance": 0.0}
    glowing = {"bsdf": black, "emitter": {"type": "area", "radiance": radiance}}
    return {"card": {"type": "sphere", "center": [0, 0, -1], "radius": 0.3, **glowing}}
"""

XML = """<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><point name="center" x="0" y="0" z="-1"/><float name="radius" value="0.3"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.25, 0.0"/></bsdf></shape>
</scene>"""


@pytest.fixture
def stream(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", [camera()], 10) as writer:
        for frame in range(3):
            writer.write(keyframe_packet(cloud(0.5), frame))
    return open_stream(tmp_path / "s.morgs")


def test_render_inserted__shows_the_scene_of_each_frame(stream, tmp_path):
    (tmp_path / "card.py").write_text(CARD)
    build = load_insert(tmp_path / "card.py")
    images = dict(render_inserted(stream, camera(), build, [0, 2], ("color", "alpha")))
    assert list(images) == [0, 2]
    for frame, expected in ((0, (0, 0, 0.735)), (2, (0.735, 0.485, 0.735))):
        assert_allclose(images[frame]["color"][12, 16], expected, atol=2e-3)
        assert images[frame]["alpha"][12, 16, 0] == 1
    alone = dict(render_stream(stream, camera(), ("color",)))[0]["color"]
    assert_allclose(images[0]["color"][:4], alone[:4], atol=2e-4)
    # The image of a camera with pixels of another height is that of square pixels, resized.
    view = camera().resized(camera().width, 2 * camera().height)
    tall = dict(render_inserted(stream, view, build, [2], ("color", "alpha")))[2]["color"]
    assert tall.shape == (view.height, view.width, 3)
    error = np.abs(0.5 * (tall[::2] + tall[1::2]) - images[2]["color"])
    assert error.max() < 0.2
    assert error.mean() < 0.01


def test_render_inserted__takes_shapes_lights_and_integrator_of_an_xml_file(stream, tmp_path):
    (tmp_path / "ball.xml").write_text(XML)
    build = load_insert(tmp_path / "ball.xml")
    config = InsertConfig(samples=64)
    ((_, images),) = render_inserted(stream, camera(), build, [1], ("color",), config)
    assert_allclose(images["color"][12, 16], (0.735, 0.537, 0), atol=0.05)


@pytest.mark.slow
def test_render_inserted__lights_a_scene_without_emitters_by_the_stream(stream):
    mirror = {"type": "conductor", "material": "none"}
    ball = {"type": "sphere", "center": [0, 0, 1.3], "radius": 0.5, "bsdf": mirror}
    images = []
    for light in ("probe", "traced"):
        config = InsertConfig(light=light)
        arguments = (lambda *_: {"ball": ball}, [0], ("color", "surfaces"), config)
        images += [image for _, image in render_inserted(stream, camera(), *arguments)]
    assert images[0]["color"][12, 16].min() > 0.05
    difference = np.abs(images[0]["color"] - images[1]["color"])
    assert difference.max() > 0.05
    assert difference.mean() < 0.05
    assert images[1]["surfaces"][..., 3].max() == 1


def test_render_inserted__refuses_an_integrator_that_does_not_trace_the_light(stream):
    def build(frame, time):
        return {"ball": {"type": "sphere"}, "integrator": {"type": "direct"}}

    with pytest.raises(
        ValueError, match="with light 'traced', expected an integrator `splat_path`, got"
    ):
        next(render_inserted(stream, camera(), build, config=InsertConfig(light="traced")))
    with pytest.raises(ValueError, match="`light` must be one of probe, traced, got 'lamp'"):
        InsertConfig(light="lamp")  # type: ignore[arg-type]


@pytest.mark.slow
def test_render_inserted__layers_compose_to_the_image_where_surfaces_cover_nothing(
    stream, tmp_path
):
    ball = {"type": "sphere", "center": [0, -0.5, -0.3], "radius": 0.4}
    sun = {"type": "directional", "direction": [0, 0.8, 0.8], "irradiance": 2.0}
    channels = inserted_channels(stream)
    assert channels == ("color", "alpha", "motion", "depth", "splats", "surfaces", "shadow")
    ((_, images),) = render_inserted(
        stream, camera(), lambda *_: {"ball": ball, "sun": sun}, [0], channels
    )
    outside = images["surfaces"][..., 3] == 0
    assert images["shadow"].min() < 0.7 < images["shadow"].max() == pytest.approx(1)
    light = images["splats"][..., :3] * images["shadow"]
    assert_allclose(decode_light(images["color"])[outside], light[outside], atol=1e-4)
    write_images([(0, images)], 10, tmp_path / "exr")
    names = read_exr(tmp_path / "exr" / "0000.exr").keys()
    assert {"R", "A", "depth.Y", "splats.R", "surfaces.A", "shadow.R", "motion.X"} <= names


def test_selected__refuses_missing_frames(stream):
    assert selected(stream, (2, 0, 2)) == [0, 2]
    with pytest.raises(ValueError, match="the frames must be out of 0 to 2, got 7"):
        selected(stream, (1, 7))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("missing.py", None, "expected a scene to insert, FILE.xml or FILE.py, got none"),
        ("a.json", "{}", "FILE.xml or FILE.py, got '.json'"),
        ("syntax.py", "def build(:", r"syntax.py: SyntaxError: .*\(syntax.py, line 1\)"),
        ("empty.py", "", r"must define `build\(frame, time\) -> dict`"),
        (
            "fails.py",
            "def build(frame, time):\n    return 1 / 0\n",
            "fails.py, line 2: ZeroDivisionError",
        ),
        (
            "none.py",
            "def build(frame, time):\n    pass\n",
            "`build` must return a dict, got a NoneType",
        ),
        ("broken.xml", "<scene", "broken.xml: "),
    ],
)
def test_load_insert__refuses_bad_files(stream, tmp_path, name, text, message):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        next(render_inserted(stream, camera(), load_insert(tmp_path / name)))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({}, "expected at least one shape, got none"),
        ({"a": {"type": "bal"}}, "The inserted scene: .*bal"),
        ({"a": {"type": "sphere", "colour": 3}}, "unreferenced property .*colour.*; correct"),
        ({"a": {"type": "sphere", "center": [np.nan, 0, 0]}}, "within 1e.12 world .*got .*nan"),
        ({"a": {"type": "sphere", "center": [1e30, 0, 0]}}, "within 1e.12 world .*got .*1e.30"),
    ],
)
def test_render_inserted__refuses_bad_scenes(stream, entries, message):
    with pytest.raises(ValueError, match=message):
        next(render_inserted(stream, camera(), lambda *_: entries))


@pytest.mark.slow
def test_render_inserted__guesses_clipped_light_of_recordings_of_8_bits_alone(tmp_path):
    ball = {"type": "sphere", "center": [0, 0, -1], "radius": 0.2}
    transfer = {"transfer": {"name": TRANSFER, "display_exposure": STOPS}}
    light = open_stream(written(tmp_path / "light.morgs", transfer))
    plain = open_stream(written(tmp_path / "plain.morgs", {}))

    def inserted(stream, clipped):
        config = InsertConfig(4, shadows=False, clipped=clipped)
        (frame,) = render_inserted(
            stream, camera(), lambda frame, time: {"ball": ball}, [0], config=config
        )
        return frame[1]["color"]

    recorded = inserted(light, 1.0)
    guessed = inserted(plain, 4.0)
    assert_array_equal(inserted(light, None), recorded)
    assert_array_equal(inserted(plain, None), guessed)
    assert np.abs(recorded - guessed).max() > 0.1
