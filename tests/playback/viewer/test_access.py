"""Access to the viewer: by other pages, hosts and machines, to files, and by broken requests."""

import os
import re
import socket
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import pytest
from starlette.datastructures import Headers

from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.playback.viewer import access
from morgs_mi.playback.viewer.access import refusal
from tests.playback.viewer.serving import exact, get, raw, viewing
from tests.scenes.changing_splats import rig, write_stream

CONNECTIONS = 200


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
