"""Streams and images in the output of a notebook's cell."""

import base64
import html
import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.codec.container import StreamWriter
from morgs_mi.playback.export import web
from morgs_mi.playback.export.web import stream_html, web_page
from morgs_mi.playback.player import channel_image, render
from morgs_mi.playback.stream_header import render_config
from morgs_mi.playback.streams import open_stream
from morgs_mi.render.rasterize import rasterize
from tests.playback.viewer.serving import decoded
from tests.scenes.changing_splats import rig, splats, write_stream


def test_stream_html__is_the_player_in_a_frame_without_access_to_the_notebook(tmp_path):
    write_stream(tmp_path / "stream.morgs")
    stream = open_stream(tmp_path)
    text = stream._repr_html_()
    assert 'sandbox="allow-scripts"' in text
    source = re.search(r'srcdoc="([^"]*)"></iframe>$', text, re.DOTALL)
    assert html.unescape(source[1]).encode() == web_page(stream)


def test_stream_html__of_a_large_stream_is_its_first_frame_and_the_command_for_a_page(
    tmp_path, monkeypatch
):
    states = write_stream(tmp_path / "stream.morgs")
    stream = open_stream(tmp_path)
    monkeypatch.setattr(web, "LARGEST", 1000)
    text = stream_html(stream)
    assert f"morgs-mi export web {stream.path} page.html" in text
    source = re.search(r"base64,([^\"]+)", text)
    image = render(states[0].gaussians, stream.cameras[0], ("color",), render_config(stream))[
        "color"
    ]
    shown = decoded(base64.b64decode(source[1])).astype(int)
    assert np.abs(shown - channel_image("color", image)).max() <= 24, "JPEG"


@pytest.mark.parametrize("largest", [0, 10**9])
def test_stream_html__of_a_stream_that_does_not_play_says_why(tmp_path, monkeypatch, largest):
    monkeypatch.setattr(web, "LARGEST", largest)
    with StreamWriter(tmp_path / "empty.morgs", rig(), 30):
        pass
    assert "expected at least one frame" in stream_html(open_stream(tmp_path / "empty.morgs"))
    write_stream(tmp_path / "stream.morgs")
    stream = open_stream(tmp_path)
    data = bytearray(stream.path.read_bytes())
    data[stream.index()[0][2] + 100] ^= 1
    stream.path.write_bytes(data)
    assert re.fullmatch(r"<div>.*stream\.morgs: packet . at byte .*</div>", stream_html(stream))


def test_image__shows_its_colour():
    image = rasterize(splats(), rig()[0], ("color", "alpha"))
    expected = channel_image("color", np.array(image.color))
    assert_array_equal(decoded(image._repr_png_() or b""), expected)
    assert rasterize(splats(), rig()[0], ("alpha",))._repr_png_() is None
