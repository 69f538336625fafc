"""What the viewer serves: bytes of a growing file, and images."""

import json
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.fingerprint import fingerprint
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.io.ply import write_ply
from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.playback.player import channel_image, picture
from morgs_mi.playback.stream_header import open_stream_capture
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.viewer import images as viewer_images
from morgs_mi.playback.viewer.images import RecordedImages
from morgs_mi.playback.viewer.server import Viewer
from morgs_mi.playback.visualise import write_png
from morgs_mi.render.rasterize import rasterize
from tests.codec.forge import damaged, with_forged_bytes, with_forged_header, with_forged_packets
from tests.playback.viewer.serving import decoded, exact, get, viewing
from tests.scenes import noise_capture
from tests.scenes.changing_splats import rig, splats, write_stream
from tests.scenes.gaussians import isotropic
from tests.scenes.short_clip import FRAMES, short_clip

# --------------------------------------------------------------------------------------------------
#  Bytes of the stream
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "status", "part"),
    [
        ("bytes=0-", 206, slice(None)),
        ("bytes=10-19", 206, slice(10, 20)),
        ("bytes=999999999999999-", 416, slice(0)),
        ("bytes=20-10", 416, slice(0)),
        # Ignored: malformed, or more than one.
        ("bytes=a-b", 200, slice(None)),
        ("bytes=-5", 200, slice(None)),
        ("bytes=0-1,3-4", 200, slice(None)),
        (f"bytes={'9' * 5000}-", 200, slice(None)),
        ("bytes=\xb2-", 200, slice(None)),
    ],
)
def test_stream_response__returns_ranges_of_bytes(url, clip, header, status, part):
    response, content = get(url, "stream.morgs", Range=header)
    assert response.status == status
    assert content == (clip[0] / "stream.morgs").read_bytes()[part]


def test_stream_response__continues_a_growing_file_and_restarts_with_a_replaced_one(tmp_path):
    write_stream(tmp_path / "stream.morgs")
    complete = (tmp_path / "stream.morgs").read_bytes()
    ends = [offset for _, _, offset in open_stream(tmp_path).index()]
    (tmp_path / "stream.morgs").write_bytes(complete[: ends[2]])
    with viewing(tmp_path) as url:
        response, content = get(url, "stream.morgs")
        tag = response.headers["ETag"]
        with (tmp_path / "stream.morgs").open("ab") as file:
            file.write(complete[ends[2] : ends[3]])
        response, more = get(url, "stream.morgs", Range=f"bytes={len(content)}-", If_Range=tag)
        assert (response.status, response.headers["ETag"]) == (206, tag)
        assert content + more == complete[: ends[3]]
        write_stream(tmp_path / "stream.morgs", start=splats(30, seed=3))  # with the same header
        response, content = get(url, "stream.morgs", Range=f"bytes={len(content)}-", If_Range=tag)
        assert response.status == 200
        assert content == (tmp_path / "stream.morgs").read_bytes()
        (tmp_path / "stream.morgs").write_bytes(b"")
        assert get(url, "stream.morgs")[1] == b""
        assert get(url, "stream.morgs", Range="bytes=5-")[0].status == 416
        (tmp_path / "stream.morgs").unlink()
        response, content = get(url, "stream.morgs")
        assert response.status == 404
        assert b"No such file" in content


def test_viewer__serves_a_provisional_first_frame_until_the_stream_has_one(tmp_path):
    stream = tmp_path / "stream.morgs"
    states = write_stream(stream)
    complete = stream.read_bytes()
    (_, _, start), (_, _, end) = open_stream(stream).index()[:2]
    stream.write_bytes(complete[:start])
    write_stream(tmp_path / PROVISIONAL, 1, splats(30, seed=3))
    camera = rig()[0]

    def shown(url):
        response, content = get(url, "stream.morgs")
        return response.headers["Content-Location"], content, get(url, exact(0, "color", camera))[1]

    with viewing(tmp_path) as url:
        location, content, image = shown(url)
        assert (location, content) == (PROVISIONAL, (tmp_path / PROVISIONAL).read_bytes())
        stream.write_bytes(complete[:end])
        location, content, final = shown(url)
        assert (location, content) == ("stream.morgs", complete[:end])
        assert image != final
        assert_image(final, states[0].gaussians, camera, "color")
        (tmp_path / PROVISIONAL).unlink()
        assert shown(url) == (location, content, final)


# --------------------------------------------------------------------------------------------------
#  Images
# --------------------------------------------------------------------------------------------------


def assert_image(content, gaussians, camera, channel):
    image = rasterize(gaussians, camera, ("color", channel))
    color = np.array(image.color)
    expected = channel_image(channel, np.array(image[channel]), 10, color)
    assert_array_equal(decoded(content), expected)


@pytest.mark.parametrize("channel", ["color", "motion"])
def test_exact_images__are_those_of_rasterize(url, clip, channel):
    for frame, camera in ((1, rig(90, 50)[1]), (3, rig()[2])):
        response, content = get(url, exact(frame, channel, camera))
        assert (response.status, response.headers["Content-Type"]) == (200, "image/png")
        assert_image(content, clip[1][frame].gaussians, camera, channel)


def test_exact_images__of_a_file_of_gaussians_are_not_quantised(tmp_path):
    write_ply(tmp_path / "scene.ply", splats())
    with viewing(tmp_path / "scene.ply") as url:
        (tmp_path / "served.morgs").write_bytes(get(url, "stream.morgs")[1])
        assert open_stream(tmp_path / "served.morgs").metadata["default_rig"] is True
        assert_image(get(url, exact(0, "color", rig()[0]))[1], splats(), rig()[0], "color")


VIEW = exact(1, "color", rig()[0]).partition("?")[2]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (f"9/color?{VIEW}", "expected a frame of the stream, got 9"),
        (f"1/quats?{VIEW}", "expected a channel of the stream, got 'quats'"),
        (f"{'9' * 5000}/color?{VIEW}", "Exceeds the limit"),
        ("1/color?camera=" + "9" * 5000, "it must have at most 4096 bytes"),
        ("1/color?camera=[[[[NaN]]]]", "got NaN"),
        (
            exact(1, "color", rig(4096, 4097)[0])[6:],
            "`width * height` must be a number in [1, 16777216]",
        ),
        (
            exact(1, "motion", rig()[0], 1e-320)[6:],
            "`motion_scale` must be a number in [1e-12, 1000000000000.0]",
        ),
    ],
)
def test_exact_images__refuse_what_the_stream_has_not_and_a_broken_view(url, path, message):
    response, content = get(url, f"exact/{path}")
    assert response.status == 400
    assert message in content.decode()


def test_exact_images__render_one_at_a_time_and_the_newest_wins(url, monkeypatch):
    running = Lock()

    def render(*args):
        assert running.acquire(blocking=False), "two at once"
        try:
            return picture(*args)
        finally:
            running.release()

    monkeypatch.setattr(viewer_images, "picture", render)
    cameras = [rig(200 + n, 200)[0] for n in range(20)]
    with ThreadPoolExecutor(len(cameras)) as pool:
        answers = list(pool.map(lambda camera: get(url, exact(1, "color", camera)), cameras))
    images = {decoded(content).shape[1] for response, content in answers if response.status == 200}
    assert {response.status for response, _ in answers} == {200, 204}
    assert images
    assert sum(response.status == 204 for response, _ in answers) > len(cameras) // 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "forge", [damaged, with_forged_bytes, with_forged_packets, with_forged_header]
)
def test_viewer__shows_or_refuses_hostile_streams(tmp_path, forge):
    path = tmp_path / "s"
    camera = rig()[0]
    wrong = []
    for seed in range(6):
        forged = forge(short_clip(), np.random.default_rng(seed))
        path.write_bytes(forged)
        try:
            viewer = Viewer(open_stream(path))
        except ValueError as error:
            wrong += [] if str(error).startswith(f"{path}: ") else [str(error)]
            continue
        viewer.close()
        for frame in range(FRAMES):
            try:
                viewer._exact._render(frame, "color", camera, 10.0)
            except ValueError as error:
                wrong += [] if str(error).startswith(f"{path}: ") else [str(error)]
    assert not wrong


@pytest.fixture
def live(tmp_path):
    """Return a stream and its capture, which grow by a frame with each call of `add`, and the
    images.
    """
    capture = tmp_path / "capture"
    images = noise_capture.clip(3)
    write_colmap(capture / "sparse" / "0", noise_capture.rig())
    (tmp_path / "capture.json").write_text(json.dumps({"capture": str(capture)}))
    splat = isotropic([[0, 0, 0]], 0.3, 0.9, (1.0, 0, 0))
    metadata = {"reading": {"gaps": True}, "test_view": None}
    with StreamWriter(tmp_path / "stream.morgs", noise_capture.rig(), 25, metadata) as writer:

        def add(frame):
            for name in noise_capture.NAMES:
                write_png(capture / name / f"{frame:04d}.png", images[frame])
            writer.write(keyframe_packet(splat, frame))

        add(0)
        yield tmp_path, add, images


def test_recorded_images__follow_a_live_fit_in_any_order(live):
    folder, add, images = live
    recorded = RecordedImages(None)
    assert_array_equal(recorded.at(open_stream(folder), 1, 0), images[0])
    with pytest.raises(
        ValueError, match="expected a camera and a frame of the stream, got 1 and 1"
    ):
        recorded.at(open_stream(folder), 1, 1)
    add(1)
    add(2)
    for view, frame in ((1, 2), (1, 2), (0, 0), (0, 1), (2, 1), (0, 2)):
        assert_array_equal(recorded.at(open_stream(folder), view, frame), images[frame])
    for file in folder.glob("capture/**/*cam0*/*0001*"):
        file.unlink()
    with pytest.raises(ValueError, match="camera 0 has no image of frame 1"):
        RecordedImages(None).at(open_stream(folder), 0, 1)


def test_viewer__sends_recorded_images_as_jpeg(live):
    folder, _, images = live
    with viewing(folder) as url:
        assert b'data-server="recorded"' in get(url)[1]
        response, content = get(url, "recorded/1/0")
        assert (response.status, response.headers["Content-Type"]) == (200, "image/jpeg")
        expected = decoded(cv2.imencode(".jpg", images[0][..., ::-1])[1].tobytes())
        assert_array_equal(decoded(content), expected)
        for path in ("recorded/3/0", "recorded/0/1", "recorded/999999999/999999999"):
            response, content = get(url, path)
            assert response.status == 400
            assert b"expected a camera and a frame of the stream" in content
        # The frame is provisional as long as the stream has none.
        stream = folder / "stream.morgs"
        (folder / PROVISIONAL).write_bytes(stream.read_bytes())
        stream.write_bytes(stream.read_bytes()[: open_stream(folder).index()[0][2]])
        assert get(url, "recorded/1/0")[0].status == 200


@pytest.mark.parametrize(
    ("mark", "status"), [(None, 400), ("", 400), ("0123456789abcdef", 400), ("right", 200)]
)
def test_viewer__shows_other_machines_only_the_recording_that_was_fitted(live, mark, status):
    """A stream from anybody may name any folder of this machine as its capture."""
    folder, _, images = live
    stream = open_stream(folder)
    if mark == "right":
        capture = open_stream_capture(stream, None, [0])
        mark = fingerprint(capture, 3 * [images[0]])
    metadata = {**stream.metadata, "fingerprint": mark}
    with StreamWriter(folder / "stream.morgs", stream.cameras, 25, metadata) as writer:
        writer.write(keyframe_packet(isotropic([[0, 0, 0]], 0.3, 0.9, (1.0, 0, 0)), 0))
    with viewing(folder, host="0.0.0.0") as url:
        assert get(url, "recorded/1/0")[0].status == status
        if mark is None:
            assert b'data-server="exact"' in get(url)[1]
            assert b"expected the fingerprint of its recording" in get(url, "recorded/1/0")[1]
    if mark is None:
        with viewing(folder, host="0.0.0.0", capture=folder / "capture") as url:
            assert get(url, "recorded/1/0")[0].status == 200


def test_viewer__names_a_capture_that_is_missing(clip, url, tmp_path):
    (clip[0] / "capture.json").write_text(json.dumps({"capture": str(tmp_path / "moved")}))
    assert b'data-server="exact"' in get(url)[1]
    response, content = get(url, "recorded/0/0")
    assert response.status == 404
    assert b"if it has moved, name its folder with --capture" in content


@pytest.mark.parametrize("capture", [5, "\0"])
def test_viewer__starts_whatever_the_path_of_its_capture_is(tmp_path, capture):
    write_stream(tmp_path / "stream.morgs", 1)
    (tmp_path / "capture.json").write_text(json.dumps({"capture": capture}))
    with viewing(tmp_path) as url:
        assert b'data-server="exact"' in get(url)[1]
