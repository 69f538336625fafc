"""Playback: channels, cameras, ground truth on the stream's grid, speed."""

import json
import shutil
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.fingerprint import fingerprint
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.playback.player import (
    MOTION_SCALE,
    channel_image,
    explained_image,
    has_confidence,
    playback_speed,
    render_stream,
)
from morgs_mi.playback.stream_header import (
    find_camera,
    num_frames,
    open_stream_capture,
    render_config,
    stream_exposure,
    stream_origin,
    truth_for_camera,
)
from morgs_mi.playback.streams import open_stream
from morgs_mi.render.render_config import RenderConfig
from tests.scenes.moving_splats import CAMERAS, FRAMES, HEIGHT, WIDTH, moved, write_stream


def capture_of(stream):
    return open_stream_capture(stream, stream.path.parent, [0])


@pytest.mark.usefixtures("small_images")
def test_truth_for_camera__resamples_to_a_coarser_grid(fitted_clip):
    small = load_capture(fitted_clip / "capture", downscale=2)
    full, half = (truth_for_camera(small, c, 1) for c in (CAMERAS[0], small.cameras[0]))
    assert_array_equal(half.mask, full.mask[1::2, 1::2])
    assert_allclose(half.motion, full.motion[1::2, 1::2] / 2)
    assert truth_for_camera(small, CAMERAS[0], FRAMES) is None


def test_render_stream__renders_the_available_channels(fitted_clip, tmp_path):
    reader = open_stream(fitted_clip)
    frames = list(render_stream(reader, find_camera(reader, 1)))
    assert [index for index, _ in frames] == list(range(FRAMES))
    shapes = {name: image.shape for name, image in frames[0][1].items()}
    assert shapes == {
        n: (HEIGHT, WIDTH, k)
        for n, k in (("color", 3), ("motion", 2), ("depth", 1), ("confidence", 1))
    }
    assert all(channel_image(n, i).shape == (HEIGHT, WIDTH, 3) for n, i in frames[0][1].items())
    write_stream(tmp_path / "s.morgs", {}, logit=None)
    assert "confidence" not in next(render_stream(open_stream(tmp_path / "s.morgs"), CAMERAS[0]))[1]


def test_render_config__ignores_settings_that_went():
    """The streams of the gallery have `reproducible` in their headers."""
    stream = open_stream(Path(__file__).parents[2] / "docs/gallery/spheres.morgs")
    assert "reproducible" in stream.metadata["config"]["render"]
    assert render_config(stream) == RenderConfig()


@pytest.mark.parametrize(
    ("metadata", "read", "message"),
    [
        (
            {"config": {"render": {"alpha_min": "x"}}},
            render_config,
            r"`config.render`: `alpha_min` must be .* got 'x'",
        ),
        (
            {"config": {"motion": 1}},
            has_confidence,
            r"`config.motion.learn_confidence` must be a table",
        ),
        (
            {"num_frames": "many"},
            num_frames,
            r"`num_frames` must be a whole number below 2.64, got 'many'",
        ),
        (
            {"test_view": 1.5},
            capture_of,
            r"`test_view` must be a list or a whole number .* or a string, got 1.5",
        ),
        (
            {"transfer": {"display_exposure": 1e9}},
            stream_exposure,
            r"`transfer.display_exposure` must be at least -100 and at most 100",
        ),
        ({"origin": [1, 2, 1e13]}, stream_origin, r"`origin` .*must be"),
        (
            {"reading": {"offset": {"cam0": 2}, "trim": 1}},
            capture_of,
            r"`trim` must be true or false, got 1",
        ),
    ],
)
def test_open_stream__metadata_of_other_types_are_refused_where_they_are_read(
    tmp_path, metadata, read, message
):
    write_stream(tmp_path / "s.morgs", metadata)
    stream = open_stream(tmp_path / "s.morgs")
    with pytest.raises(ValueError, match=rf"s.morgs: packet 0: .*{message}"):
        read(stream)
    assert len(list(stream)) == FRAMES


def test_find_camera__by_index_and_name(fitted_clip):
    stream = open_stream(fitted_clip)
    assert [find_camera(stream, camera).name for camera in (1, "1", "cam0")] == [
        "cam1",
        "cam1",
        "cam0",
    ]
    for camera in (2, -1, "-1", "cam7"):
        with pytest.raises(ValueError, match=r"index in 0..1 or one of cam0, cam1, got"):
            find_camera(stream, camera)


def test_has_confidence__only_where_it_was_learned(fitted_clip, tmp_path):
    assert has_confidence(open_stream(fitted_clip))
    off = {"config": {"motion": {"learn_confidence": False}}}
    write_stream(tmp_path / "off.morgs", off)
    write_stream(tmp_path / "none.morgs", {}, logit=None)
    assert not has_confidence(open_stream(tmp_path / "off.morgs"))
    assert not has_confidence(open_stream(tmp_path / "none.morgs"))


def test_playback_speed__is_the_inverse_of_the_time_per_frame(fitted_clip, tmp_path):
    config = RenderConfig()
    reader = open_stream(fitted_clip)
    times = playback_speed(reader, reader.cameras[0], config)
    assert times["fps"] == pytest.approx(1e3 / (times["decode_ms"] + times["render_ms"]))
    assert min(times.values()) > 0
    with StreamWriter(tmp_path / "s.morgs", CAMERAS, 25) as writer:
        writer.write(keyframe_packet(moved(0), 0))
    assert playback_speed(open_stream(tmp_path / "s.morgs"), CAMERAS[0], config)["fps"] > 0


def test_channel_image__draws_other_channels_as_grey_values():
    ramp = np.linspace(0, 1, 8, dtype=np.float32)[None, :, None]
    image = channel_image("wetness", ramp)
    assert (image == image[..., :1]).all()
    assert_array_equal(image, channel_image("alpha", ramp))


@pytest.mark.parametrize("name", ["confidence", "error", "depth"])
def test_explained_image__has_a_bar_of_the_colours_between_numbers_along_the_lower_edge(name):
    largest = 0.1 if name == "error" else 1
    values = np.full((60, 400, 1), largest, np.float32)
    values[:, :200] = largest / 2 if name == "depth" else 0
    image = explained_image(name, values)
    drawn = channel_image(name, values)
    assert_array_equal(image[30], drawn[30])
    bar = image[-1]
    first, last = (np.flatnonzero((bar == drawn[30, k]).all(axis=1)) for k in (0, -1))
    assert 0 < first[0] < 60, "after the number at the left"
    assert 340 < last[-1] < 399
    assert len(np.unique(bar, axis=0)) > 90
    assert not np.array_equal(image[:10], explained_image(name, values, title="other")[:10])


def test_explained_image__has_the_wheel_of_motion_in_a_corner():
    still = np.zeros((100, 200, 2))
    image = explained_image("motion", still)
    size = 21
    assert (image[-size:, :-size] == 255).all()
    right = channel_image("motion", still + np.array([MOTION_SCALE * 200 * 0.9, 0]))[0, 0]
    assert np.abs(image[-size // 2, -2] - right.astype(int)).max() < 30
    grey = explained_image("motion", still, color=np.full((100, 200, 3), 0.5))
    assert (grey[-size:, :-size] == 128).all()
    color = np.random.default_rng(0).uniform(size=(9, 9, 3))
    assert_array_equal(explained_image("color", color), channel_image("color", color))


@pytest.mark.parametrize("refine", ["off", "on"])
def test_open_stream_capture__recognises_the_recording_by_its_fingerprint(
    fitted_clip, tmp_path, refine
):
    capture = load_capture(fitted_clip / "capture", test_view=0)
    mark = fingerprint(capture, next(capture.partial_frames()).images, refine == "on")
    for mark_of_stream, refused in ((mark, False), ("0" * 16, True), (None, False)):
        metadata = {
            "test_view": 0,
            "fingerprint": mark_of_stream,
            "config": {"fit": {"refine_cameras": refine}},
        }
        write_stream(tmp_path / "stream.morgs", metadata)
        stream = open_stream(tmp_path)
        with (
            pytest.raises(ValueError, match="expected the recording that")
            if refused
            else nullcontext()
        ):
            open_stream_capture(stream, capture.path, [0, 1, 2])
        assert (
            open_stream_capture(stream, capture.path, [0, 1, 2], any_recording=True).path
            == capture.path
        )


def test_open_stream_capture__asks_for_a_capture_that_has_moved(fitted_clip, tmp_path):
    write_stream(tmp_path / "stream.morgs", {"test_view": 0, "capture": str(fitted_clip)})
    for content in ("{", "[]", '{"capture": null}'):
        (tmp_path / "capture.json").write_text(content)
        with pytest.raises(
            FileNotFoundError,
            match=r"stream\.morgs: expected the path of its capture .* found none; .* --capture\.$",
        ):
            open_stream_capture(open_stream(tmp_path), None, [0, 1, 2])
    (tmp_path / "capture.json").write_text(json.dumps({"capture": str(tmp_path / "old")}))
    with pytest.raises(
        FileNotFoundError,
        match=rf"expected the path of its capture .* found {tmp_path}/old; .* --capture\.$",
    ):
        open_stream_capture(open_stream(tmp_path), None, [0, 1, 2])
    shutil.copytree(fitted_clip / "capture", tmp_path / "new")
    assert (
        open_stream_capture(open_stream(tmp_path), tmp_path / "new", [0, 1, 2]).path
        == tmp_path / "new"
    )
