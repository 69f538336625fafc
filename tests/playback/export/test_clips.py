"""`morgs-mi export` and `render`: one file per frame and videos, through the command line."""

import json
from dataclasses import replace

import av
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.cli.main import main
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.clip_readers import open_frames
from morgs_mi.io.ply import read_ply
from morgs_mi.playback.export.clips import (
    named_path,
)
from morgs_mi.playback.export.formats import IMAGES, PLY, USD, WEB, choose_format
from morgs_mi.playback.export.frames import exr_channels, pad_to_even
from morgs_mi.playback.export.web import write_web_folder
from morgs_mi.render.rasterize import rasterize
from morgs_mi.testing import assert_close
from tests.scenes.cameras import moved
from tests.scenes.changing_splats import rig, write_stream


@pytest.fixture
def stream(tmp_path):
    return write_stream(tmp_path / "stream.morgs")


def run(*args):
    return main([str(arg) for arg in args])


def write_path(file, cameras, seconds=1.0, **size):
    """Write a camera path from one camera to the next, `seconds` for each."""
    keys = [
        {"time": seconds * k, "viewmat": np.asarray(camera.viewmat).tolist()}
        for k, camera in enumerate(cameras)
    ]
    file.write_text(json.dumps({"keys": keys, **size}))


def test_export_ply__writes_every_frame(stream, tmp_path):
    assert run("export", "ply", tmp_path) == 0
    assert [path.name for path in sorted((tmp_path / "ply").iterdir())] == [
        f"{t:04d}.ply" for t in range(4)
    ]
    for t, state in enumerate(stream):
        read = read_ply(tmp_path / "ply" / f"{t:04d}.ply")
        assert_array_equal(read.numpy()["means"], state.gaussians.numpy()["means"])


def test_export__uses_the_origin_of_the_header(tmp_path, capsys):
    metadata = {"origin": [500000.0, 5300000.0, 0]}
    write_stream(tmp_path / "stream.morgs", metadata=metadata)
    stream = StreamReader(tmp_path / "stream.morgs")
    far = moved(stream.cameras[:2], -np.array(metadata["origin"]))
    write_path(tmp_path / "path.json", far)
    path = named_path(stream, str(tmp_path / "path.json"))
    for key, camera in zip(path.keys, stream.cameras[:2], strict=True):
        assert_close(key.viewmat, camera.viewmat, atol=1e-6)
    assert run("export", "ply", tmp_path, "--frames", "0") == 0
    assert "relative to the origin (500000, 5300000, 0)" in capsys.readouterr().out
    write_web_folder(stream, tmp_path / "web")
    published = tmp_path / "web/stream.morgs"
    assert StreamReader(published).metadata["origin"] == metadata["origin"]
    assert run("export", "web", published, tmp_path / "again.html") == 0


@pytest.mark.parametrize("name", ["orbit", "between", "path.json"])
def test_named_path__has_no_image_of_a_camera_behind_its_views(tmp_path, monkeypatch, name):
    """A path in a file may claim any size, to which the image would be enlarged."""
    monkeypatch.chdir(tmp_path)
    write_path(tmp_path / "path.json", rig()[:1] * 2, width=10**9, height=9)
    cameras = [replace(c, background=np.zeros((c.height, c.width, 3))) for c in rig()]
    write_stream(tmp_path / "stream.morgs", cameras=cameras)
    path = named_path(StreamReader(tmp_path / "stream.morgs"), name)
    assert all(key.background is None for key in path.keys)


@pytest.mark.parametrize(("kind", "name"), [("ply", "a.compressed.ply"), ("gltf", "a.glb")])
def test_export__writes_one_frame_into_a_file(stream, tmp_path, capsys, kind, name):
    suffix = name.removeprefix("a")
    assert run("export", kind, tmp_path, tmp_path / name, "--frames", 2) == 0
    assert capsys.readouterr().out.rstrip().endswith(" file.")
    folder = tmp_path / ("compressed-ply" if "compressed" in name else "folder")
    assert run("export", kind, tmp_path, folder, "--frames", 2) == 0
    assert (tmp_path / name).read_bytes() == (folder / f"0002{suffix}").read_bytes()


@pytest.mark.parametrize(
    ("formats", "output", "expected"),
    [
        (WEB, None, "html"),
        (WEB, "a/Page.HTML", "html"),
        (PLY, "a/frames-compressed-ply", "compressed.ply"),
        (PLY, "a/b-compressed.ply", "ply"),
        (IMAGES, "a/frames-png", "png"),
        (IMAGES, "b.mp4", "mp4"),
        (IMAGES, "b.webm", "webm"),
        (USD, "b.usda", "usda"),
    ],
)
def test_choose_format__follows_the_name_of_the_output(formats, output, expected):
    assert choose_format(formats, output).name == expected


def test_export__refuses_a_folder_in_place_of_a_file_before_it_begins(stream, tmp_path, capsys):
    for name in ("page.html", "web"):
        (tmp_path / name).mkdir()
        assert run("export", "web", tmp_path, tmp_path / name) == 1
    errors = capsys.readouterr().err.splitlines()
    assert (
        errors[0]
        == f"{tmp_path}/page.html: expected a file to write, got a folder; choose another name."
    )
    assert (
        errors[-1]
        == f"{tmp_path}/web: expected a new folder, got one that exists; remove it first."
    )


def test_flight__shows_rendered_images_again(stream, tmp_path):
    write_path(tmp_path / "still.json", rig()[1:2] * 2, 0.6)
    assert run("export", "video", tmp_path, "--path", tmp_path / "still.json") == 0
    expected = [
        np.clip(np.array(rasterize(state.gaussians, rig()[1]).color), 0, 1) for state in stream
    ]
    errors = [
        [np.abs(frame / 255 - image).mean() for image in expected]
        for frame in open_frames(tmp_path / "still.mp4").frames()
    ]
    assert np.argmin(errors, axis=1).tolist() == [0, 1, 2, 3, 0, 1]
    assert np.min(errors, axis=1).max() < 0.03  # of the lossy codec on such a small image


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "h264"), ("a.webm", "vp9")])
def test_render__writes_videos_that_players_open(stream, tmp_path, name, codec):
    assert run("render", tmp_path, tmp_path / name, "--camera", 0) == 0
    with av.open(str(tmp_path / name)) as container:
        image = next(container.decode(video=0))
        context = container.streams.video[0].codec_context
        assert (context.name.removeprefix("lib"), context.pix_fmt) == (codec, "yuv420p")
        # BT.709, of limited range.
        assert (image.colorspace, image.color_range) == (1, 1)
    if codec == "h264":  # a page plays it while it is loaded
        data = (tmp_path / name).read_bytes()
        assert data.index(b"moov") < data.index(b"mdat")


def test_export_video__repeats_a_short_clip(stream, tmp_path):
    assert run("export", "video", tmp_path, "--least-seconds", 1, "--width", 32) == 0
    # Three plays of 4 frames at 10 frames per second.
    assert open_frames(tmp_path / "between.mp4").num_frames == 12


def test_flight__freezes_a_frame_while_the_camera_moves(stream, tmp_path):
    more = ("--freeze", 2, "--seconds", 0.5, "--width", 32, "--channels", "color", "depth")
    assert run("export", "video", tmp_path, "--path", "orbit", *more) == 0
    assert [frame.shape for frame in open_frames(tmp_path / "orbit.mp4").frames()] == [
        (24, 68, 3)
    ] * 5


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("ply", "--frames", "9"), "stream.morgs, 0 to 3, got '9'"),
        (
            ("ply", "--frames", "a:b"),
            "`frames` must be like 12, 10:20 or 0:100:5 and select frames of",
        ),
        (("video", "x.avi"), "x.avi: the output must be FILE.mp4 or FILE.webm, got '.avi'; name "),
        (
            ("ply", "a.glb"),
            "must be FILE.ply or FILE.compressed.ply or a folder or a folder ending in "
            "compressed-ply, got '.glb'; name ",
        ),
        (
            ("ply", "a.ply"),
            "a.ply: expected one frame for one file, got several; select one (--frames), or name a "
            "folder.",
        ),
        (("video", "--freeze", "7"), "--freeze must be in 0 to 3, got 7"),
        (
            ("video", "--path", "none.json"),
            "(orbit, between or a JSON file), found none",
        ),
    ],
)
def test_export__errors_are_one_sentence(stream, tmp_path, capsys, args, message):
    assert run("export", args[0], tmp_path, *args[1:]) == 1
    assert message in " ".join(capsys.readouterr().err.split())


def test_exr_channels__names_follow_the_number_of_components():
    images = {
        name: np.zeros((2, 3, k))
        for name, k in (("alpha", 1), ("wet", 1), ("normal", 3), ("wide", 5))
    }
    normal = ["normal.X", "normal.Y", "normal.Z"]
    assert list(exr_channels(images)) == ["A", "wet.Y", *normal, *(f"wide.{i}" for i in range(5))]


def test_pad_to_even__repeats_the_last_row_and_column():
    image = np.arange(45, dtype=np.uint8).reshape(3, 5, 3)
    repeated = image[[0, 1, 2, 2]][:, [0, 1, 2, 3, 4, 4]]
    assert_array_equal(pad_to_even(image), repeated)
