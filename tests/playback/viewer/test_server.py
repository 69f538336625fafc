"""The server of the viewer without a browser: bytes of a growing file, images, and hostile
requests.
"""

import html
import json
import os
import re
import signal
import socket
import subprocess
import sys
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from threading import Lock, Thread
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from starlette.datastructures import Headers

from morgs_mi.capture.fingerprint import fingerprint
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.cli.main import main
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.io.ply import write_ply
from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.playback.player import channel_image, picture
from morgs_mi.playback.stream_header import open_stream_capture
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.viewer import access
from morgs_mi.playback.viewer import images as viewer_images
from morgs_mi.playback.viewer.access import refusal
from morgs_mi.playback.viewer.images import RecordedImages
from morgs_mi.playback.viewer.server import Viewer
from morgs_mi.playback.visualise import write_png
from morgs_mi.render.rasterize import rasterize
from tests.codec.forge import damaged, with_forged_bytes, with_forged_header, with_forged_packets
from tests.playback.viewer.serving import decoded, exact, get, raw, viewing
from tests.scenes import noise_capture
from tests.scenes.changing_splats import rig, splats, write_stream
from tests.scenes.gaussians import isotropic
from tests.scenes.programs import run_script
from tests.scenes.short_clip import FRAMES, short_clip

CONNECTIONS = 200


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Return the folder of a stream and its states."""
    folder = tmp_path_factory.mktemp("clip")
    return folder, write_stream(folder / "stream.morgs")


@pytest.fixture(scope="module")
def url(clip):
    with viewing(clip[0]) as url:
        yield url


# --------------------------------------------------------------------------------------------------
#  Access
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("LOCALHOST:9000", "http://localhost:9000"),  # a forwarded port
        ("[::1]:8080", "http://[::1]:8080"),
        ("lab.example:8080", None),  # a request of the page itself, or no browser
    ],
)
def test_refusal__accepts_the_viewers_own_page(host, origin):
    headers = {"host": host} | ({} if origin is None else {"origin": origin})
    assert refusal(Headers(headers), "Lab.Example") is None


@pytest.mark.parametrize(
    ("headers", "message"),
    [
        (
            {"host": "localhost:8080", "origin": "http://localhost:3000"},
            "got one of 'http://localhost:3000'",
        ),
        ({"host": "localhost:8080", "origin": "null"}, "the viewer's own page at localhost:8080"),
        (
            {"host": "evil.example:8080", "origin": "http://evil.example:8080"},
            "got the host 'evil.example'",
        ),
        ({"host": "localhost.evil.example"}, "got the host 'localhost.evil.example'"),
        ({"host": "user@localhost@evil.example"}, "got the host 'evil.example'"),
        ({"host": "localhost", "origin": "http://[evil"}, "expected a host and an origin"),
        (
            {"host": "localhost", "sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"},
            "one of another page",
        ),
        ({"host": "localhost", "sec-fetch-site": "same-site"}, "one of another page"),
    ],
)
def test_refusal__names_a_foreign_page_or_host(headers, message):
    assert message in str(refusal(Headers(headers), "127.0.0.1"))


@pytest.mark.parametrize("path", ["/exact/0/color", "/nothing"])
def test_viewer__refuses_other_pages_and_rebound_names(url, path):
    port = url.rstrip("/").rpartition(":")[2]
    foreign = raw(
        url, f"GET {path} HTTP/1.1", f"Host: localhost:{port}", "Origin: https://evil.example"
    )
    rebound = raw(
        url,
        f"GET {path} HTTP/1.1",
        f"Host: evil.example:{port}",
        f"Origin: http://evil.example:{port}",
    )
    assert foreign.startswith("HTTP/1.1 403 ")
    assert rebound.startswith("HTTP/1.1 403 ")
    assert "got the host 'evil.example'" in rebound
    assert raw(url, f"GET {path} HTTP/1.1").startswith(("HTTP/1.1 400 ", "HTTP/1.1 403 ")), (
        "no host"
    )


@pytest.mark.parametrize(
    "path",
    [
        "..%2fsecret",
        "%2e%2e/secret",
        "stream.morgs/../../secret",
        "stream.morgs%00",
        "recorded/0/..%2f..%2fsecret",
        "capture.json",
    ],
)
def test_viewer__serves_no_other_files(url, clip, path):
    (clip[0].parent / "secret").write_text("secret")
    (clip[0] / "secret").write_text("secret")
    (clip[0] / "capture.json").write_text('{"capture": "secret"}')
    response, content = get(url, path)
    assert response.status in (400, 404)
    assert b"secret" not in content or response.status == 400, (
        "at most a sentence with the path itself"
    )
    assert b"root:" not in content


def test_viewer__requires_the_token_where_other_machines_can_reach_it(clip):
    with viewing(clip[0], host="0.0.0.0") as url, viewing(clip[0], host="0.0.0.0") as other:
        start, token, _ = url.rsplit("/", 2)
        assert len(token) >= 40
        assert token not in other
        assert re.fullmatch(r"http://localhost:\d+", start)
        for path in ("", "stream.morgs"):
            assert get(url, path)[0].status == 200
            for wrong in (
                "/",
                f"/{token[:-1]}/",
                f"/{token}x/",
                f"/{token.lower()}/",
                "/%FF/",
                f"/?token={token}/",
            ):
                response, content = get(start + wrong, path)
                assert response.status == 403
                assert b"expected the token" in content
        assert get(start + "/" + token)[0].status == 403


@pytest.mark.parametrize(
    "lines",
    [("GET / HTTP/1.1\x00",), ("\x16\x03\x01",), ("A" * 99999,)],
)
def test_viewer__survives_what_is_no_http(url, lines):
    assert raw(url, *lines).startswith("HTTP/1.1 400 ")
    assert get(url)[0].status == 200


def test_viewer__answers_many_connections_at_once(url, clip):
    idle = [
        socket.create_connection(("127.0.0.1", int(url.rstrip("/").rpartition(":")[2])))
        for _ in range(CONNECTIONS)
    ]
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        answers = list(pool.map(lambda _: get(url, "stream.morgs")[1], range(CONNECTIONS)))
    assert set(answers) == {(clip[0] / "stream.morgs").read_bytes()}
    for connection in idle:
        connection.close()
    assert get(url)[0].status == 200


def test_viewer__ends_connections_without_progress_and_beyond_a_limit(clip, monkeypatch):
    monkeypatch.setattr(access, "PATIENCE", 0.5)
    monkeypatch.setattr(access, "MOST", 8)
    with viewing(clip[0]) as url:

        def begun():
            connection = socket.create_connection(("127.0.0.1", urlsplit(url).port), timeout=5)
            connection.sendall(b"GET / HT")
            return connection

        first = begun()
        assert first.recv(1) == b"", "its head is not finished in time"
        crowd = [begun() for _ in range(20)]
        assert get(url)[0].status == 200, "an unfinished one made room"
        slow = begun()
        slow.sendall(b"TP/1.1\r\n")
        assert slow.recv(1) == b"", "a few bytes are no progress"
        for connection in (first, slow, *crowd):
            connection.close()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="links and pipes")
@pytest.mark.parametrize("name", ["stream.morgs", PROVISIONAL])
@pytest.mark.parametrize("secret", [b"MORGS-MI secret", None])
def test_viewer__serves_regular_files_of_its_folder_alone(tmp_path, name, secret):
    folder = tmp_path / "folder"
    folder.mkdir()
    write_stream(folder / "stream.morgs", 0)
    (tmp_path / "secret").write_bytes(secret or b"")
    with viewing(folder) as url:
        (folder / name).unlink(missing_ok=True)
        if secret is None:
            os.mkfifo(folder / name)
        else:
            (folder / name).symlink_to(tmp_path / "secret")
        for path in ("stream.morgs", exact(0, "color", rig()[0]), "recorded/0/0"):
            assert all(b"secret" not in get(url, path)[1] for _ in range(2))
        (folder / name).unlink()
        write_stream(folder / "stream.morgs")
        response, content = get(url, "stream.morgs")
        assert (response.status, content) == (200, (folder / "stream.morgs").read_bytes())


@pytest.mark.skipif(os.name == "nt", reason="links")
def test_viewer__names_a_stream_that_has_become_a_link_to_itself(tmp_path):
    path = tmp_path / "stream.morgs"
    write_stream(path)
    with viewing(path) as url:
        path.unlink()
        path.symlink_to(path)
        assert get(url)[0].status == 200
        for part in ("stream.morgs", exact(0, "color", rig()[0]), "recorded/0/0"):
            response, content = get(url, part)
            assert response.status == 400
            assert b"expected a file, got a link" in content


@pytest.mark.parametrize("name", ["a\nb", "\udcff"])
def test_viewer__serves_streams_of_any_name(tmp_path, name):
    path = tmp_path / f"{name}.morgs"
    write_stream(path)
    with viewing(path) as url:
        assert get(url, "stream.morgs")[1] == path.read_bytes()
        path.unlink()
        assert get(url, "stream.morgs")[0].status == 404


def test_stream_response__ends_where_its_file_was_cut_off_meanwhile(clip, tmp_path, capfd):
    path = tmp_path / "stream.morgs"
    data = (clip[0] / "stream.morgs").read_bytes() + bytes(2**24)
    path.write_bytes(data)
    with viewing(path) as url:
        with socket.create_connection(("127.0.0.1", urlsplit(url).port), timeout=30) as connection:
            connection.sendall(b"GET /stream.morgs HTTP/1.1\r\nHost: localhost\r\n\r\n")
            answer = connection.recv(2**16)
            os.truncate(path, 2**20)
            while not answer.endswith(b"\r\n0\r\n\r\n"):
                answer += connection.recv(2**20)
        assert len(answer) < len(data)
    assert "Traceback" not in capfd.readouterr().err


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


# --------------------------------------------------------------------------------------------------
#  The command
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "link", "opens"),
    [
        ((), r"http://127\.0\.0\.1:\d+/", ""),
        (("--follow",), r"http://127\.0\.0\.1:\d+/", "#follow"),
        (("--camera", "2"), r"http://127\.0\.0\.1:\d+/", "#camera=right"),
        (("--no-browser", "--host", "0.0.0.0"), r"http://localhost:\d+/[\w-]{40,}/", None),
    ],
)
def test_view__prints_and_opens_the_link(clip, monkeypatch, capsys, args, link, opens):
    """With a token where other machines can reach it."""
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(Viewer, "run", lambda viewer: viewer.close())
    assert main(["view", str(clip[0]), *args]) == 0
    output = " ".join(capsys.readouterr().out.split())
    url = re.search(link, output)
    assert opened == ([] if opens is None else [url[0] + opens])
    note = "Other machines open the same link with the address of this machine in digits."
    assert (note in output) == ("--host" in args)


def test_view__shows_the_first_frame_from_the_camera_until_the_page_draws(clip, monkeypatch):
    run = Viewer.run
    pages = []

    def visited(viewer):
        thread = Thread(target=run, args=(viewer,))
        thread.start()
        pages.append(get(viewer.url)[1].decode())
        viewer.stop()
        thread.join(60)

    monkeypatch.setattr(Viewer, "run", visited)
    assert main(["view", str(clip[0]), "--no-browser", "--camera", "right"]) == 0
    (poster,) = re.findall('src="(exact/[^"]+)"', pages[0])
    camera = parse_qs(urlsplit(html.unescape(poster)).query)["camera"][0]
    assert json.loads(camera)["name"] == "right"


def test_view__refuses_a_port_that_is_taken(clip, capsys):
    with socket.create_server(("127.0.0.1", 0)) as socket_in_use:
        port = socket_in_use.getsockname()[1]
        assert main(["view", str(clip[0]), "--port", str(port), "--no-browser"]) == 1
    assert f"127.0.0.1:{port}: cannot serve the page there" in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_view__ends_on_ctrl_c(clip):
    code = "import sys; from morgs_mi.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "view", str(clip[0]), "--no-browser"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell ignores SIGINT for the processes that it starts in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as server:
        link = next(line for line in server.stdout if "http://" in line)
        assert get(link.split()[0], exact(0, "color", rig()[0]))[0].status == 200
        server.send_signal(signal.SIGINT)
        _, errors = server.communicate(timeout=60)
    assert server.returncode == 130, errors
    assert "Traceback" not in errors


@pytest.mark.slow
def test_starlette__is_not_imported_by_the_other_commands():
    code = "import sys, morgs_mi.cli; sys.exit('starlette' in sys.modules)"
    assert run_script(code).returncode == 0
