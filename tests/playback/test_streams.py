"""Files of Gaussians as streams of one frame: exact Gaussians, every output, and messages for other
files.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from plyfile import PlyData

from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import decode, keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.exr import read_exr
from morgs_mi.io.ply import write_ply
from morgs_mi.io.splats import read_splats
from morgs_mi.playback.export.web import write_web_folder
from morgs_mi.playback.player import picture
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import GAP, label
from morgs_mi.render.rasterize import rasterize
from morgs_mi.testing import assert_close
from tests.cli.commands import assert_refused
from tests.cli.conftest import run
from tests.scenes.changing_splats import splats, write_stream

__all__ = ["run"]


@pytest.fixture(params=(0, 3), ids=lambda degree: f"degree {degree}")
def file(tmp_path, request):
    write_ply(tmp_path / "scene.ply", splats(degree=request.param))
    return tmp_path / "scene.ply"


def test_splat_file__has_the_gaussians_of_the_file_in_one_frame(file):
    stream = open_stream(file)
    expected = read_splats(file).numpy()
    for gaussians in (
        next(gaussians for _, gaussians in play(stream)),
        stream.seek(0).gaussians,
    ):
        arrays = gaussians.numpy()
        for name, values in expected.items():
            assert_array_equal(arrays[name], values)
    assert stream.frame_numbers() == [0]
    with pytest.raises(ValueError, match=r"scene\.ply: expected a frame of the stream, got 1"):
        stream.seek(1)


def test_splat_file__is_coded_like_any_keyframe(file, tmp_path):
    stream = open_stream(file)
    write_web_folder(stream, tmp_path / "page")
    written = StreamReader(tmp_path / "page" / "stream.morgs")
    assert written.metadata["default_rig"] is True
    assert [camera.name for camera in written.cameras] == [camera.name for camera in stream.cameras]
    packet = keyframe_packet(read_splats(file), 0, stream.cameras)
    assert_array_equal(written.seek(0).digest, decode(None, packet).digest)
    assert [written_packet.encoded for written_packet in written] == [packet.encoded]


def test_render__draws_a_file_of_gaussians(tmp_path, run):
    write_ply(tmp_path / "scene.ply", splats(degree=2))
    stream = open_stream(tmp_path / "scene.ply")
    status, output, _ = run("render", stream.path, tmp_path / "a.png", "--width", 64)
    assert status == 0
    first, *others = [camera.name for camera in stream.cameras]
    assert output.splitlines() == [
        f"{tmp_path}/a.png: 1 image.",
        f"Seen from {first} (most detail); also --camera {', '.join(others)} or all.",
    ]
    image = np.array(rasterize(read_splats(stream.path), stream.cameras[0].with_width(64)).color)
    assert_close(
        cv2.imread(str(tmp_path / "a.png"))[..., ::-1] / 255,
        image.clip(0, 1),
        atol=0.5 / 255 + 1e-4,
    )
    assert (
        run("render", stream.path, tmp_path / "a.exr", "--width", 64, "--camera", "right")[0] == 0
    )
    assert read_exr(tmp_path / "a.exr")["depth.Y"].shape == (36, 64)


def test_render__draws_a_thumbnail_for_each_camera(tmp_path, run):
    write_ply(tmp_path / "scene.ply", splats(degree=2))
    stream = open_stream(tmp_path / "scene.ply")
    status, output, _ = run("render", stream.path, "--camera", "all", "--width", 64)
    assert (status, output) == (0, f"{tmp_path}/scene-all.png: 8 cameras.\n")
    sheet = cv2.imread(str(tmp_path / "scene-all.png"))[..., ::-1]
    assert sheet.shape == (2 * 36 + GAP, 4 * 64 + 3 * GAP, 3)
    camera = stream.cameras[6].resized(64, 36)
    expected = label(picture(stream, read_splats(stream.path), camera), camera.name)
    left = 2 * (64 + GAP)
    assert np.array_equal(sheet[36 + GAP :, left : left + 64], expected)
    assert_refused(
        run("render", stream.path, tmp_path / "a.mp4", "--camera", "all"), "must be FILE.png"
    )


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (
            ("a.png", "--path", "orbit"),
            "a.png: expected one image for one file, got 150; name a folder",
        ),
        (("--camera", "0", "--path", "orbit"), "expected --camera or --path, got both"),
        (
            ("a.png", "--camera", "front", "--display-exposure", "nan"),
            "`display_exposure` must be a number in [-100, 100], got nan",
        ),
    ],
)
def test_render__names_arguments_that_do_not_fit(tmp_path, run, args, message):
    write_ply(tmp_path / "scene.ply", splats())
    assert_refused(run("render", tmp_path / "scene.ply", *args), message)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_info__names_damaged_frames_and_refuses_the_options_of_captures(tmp_path, run, caplog):
    path = tmp_path / "a.morgs"
    write_stream(path, keyframe_interval=2)
    assert run("info", path)[0] == 0
    assert not caplog.messages
    refused = run("info", path, "--plot", tmp_path / "a.png")
    assert_refused(refused, "expected a capture, which the options of info are for, got a stream")
    _, _, offset = StreamReader(path).index()[1]
    data = bytearray(path.read_bytes())
    data[offset + 40] ^= 1
    path.write_bytes(data)
    assert run("info", path)[0] == 0
    assert "the damaged frames 1 are skipped" in caplog.text


def test_open_stream__warns_of_a_stream_without_an_index(tmp_path, caplog):
    path = tmp_path / "a.morgs"
    write_stream(path)
    path.write_bytes(path.read_bytes()[:-5])
    open_stream(path)
    assert "without an index, and may lack later frames" in caplog.text


def with_nan(path, rows):
    """Write 40 splats, the first of which have no finite centre."""
    write_ply(path, splats())
    file = PlyData.read(path, mmap=False)
    file["vertex"]["x"][:rows] = np.nan
    file.write(path)
    return path


def test_export__writes_no_other_number_of_gaussians_unasked(tmp_path, run):
    path = with_nan(tmp_path / "a.ply", 1)
    sentence = "others in 1 of 40 Gaussians (centre of 0); leave them out with --drop-invalid"
    assert_refused(run("export", "ply", path), sentence)
    assert [file.name for file in tmp_path.iterdir()] == ["a.ply"]
    assert run("export", "ply", path, "--drop-invalid")[0] == 0


def test_render__draws_without_invalid_gaussians_up_to_a_share(tmp_path, run, caplog):
    image = tmp_path / "a.png"
    assert run("render", with_nan(tmp_path / "a.ply", 2), image, "--width", 32)[0] == 0
    assert "a.ply: 2 of 40 Gaussians are left out" in caplog.text
    path = with_nan(tmp_path / "a.ply", 30)
    assert_refused(run("render", path, image), "others in 30 of 40 Gaussians")
    assert run("render", path, image, "--width", 32, "--drop-invalid")[0] == 0
    nothing = run("render", with_nan(path, 40), image, "--drop-invalid")
    assert_refused(nothing, "expected at least one Gaussian, got none")


@pytest.mark.parametrize("link", [None, Path.symlink_to, Path.hardlink_to])
def test_export__does_not_replace_its_source(tmp_path, run, link):
    write_ply(tmp_path / "a.ply", splats())
    content = (tmp_path / "a.ply").read_bytes()
    output = tmp_path / "a.ply" if link is None else tmp_path / "b.ply"
    if link is not None:
        link(output, tmp_path / "a.ply")
    refused = run("export", "ply", tmp_path / "a.ply", output)
    assert_refused(refused, f"{output}: expected an output beside its source")
    assert (tmp_path / "a.ply").read_bytes() == content
    assert run("export", "ply", tmp_path / "a.ply", tmp_path / "c.ply")[0] == 0
