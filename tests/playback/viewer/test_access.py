"""Connections to the viewer from its own page, from other pages, and under foreign names."""

from __future__ import annotations

import base64
import os
import socket
from threading import Thread

import pytest

from morgs_mi import cli
from morgs_mi.playback.viewer.access import checked_connections, refusal
from morgs_mi.playback.viewer.viewer import Viewer, ViewerConfig
from tests.scenes.changing_splats import write_stream


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("localhost:9000", "http://localhost:9000"),  # a forwarded port
        ("LOCALHOST:8080", "http://localhost:8080"),
        ("[::1]:8080", "http://[::1]:8080"),
        ("192.168.0.7:8080", "http://192.168.0.7:8080"),
        ("lab.example:8080", "http://lab.example:8080"),
        ("lab.example", "https://lab.example"),  # behind a proxy
        ("localhost:8080", None),  # not a browser
    ],
)
def test_refusal__accepts_the_viewers_own_page(host, origin):
    assert refusal(host, origin, ("Lab.Example",)) is None


@pytest.mark.parametrize(
    ("host", "origin", "message"),
    [
        ("localhost:8080", "https://evil.example", "got one from 'https://evil.example'"),
        ("localhost:8080", "http://localhost:3000", "got one from 'http://localhost:3000'"),
        ("localhost:8080", "null", "the viewer's own page at localhost:8080"),
        ("evil.example:8080", "http://evil.example:8080", "got the host 'evil.example'"),
        ("localhost.evil.example", None, "add --allowed-names localhost.evil.example"),
        ("127.0.0.1.evil.example", None, "got the host"),
        ("user@localhost@evil.example", None, "got the host 'evil.example'"),
        (None, None, "got the host ''"),
        ("", "http://", "got the host ''"),
    ],
)
def test_refusal__names_a_foreign_page_or_host(host, origin, message):
    assert message in str(refusal(host, origin))


def test_checked_connections__fail_where_no_server_is_checked():
    with pytest.raises(RuntimeError, match="expected viser to serve through websockets"), checked_connections():
        pass


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")
    folder = tmp_path_factory.mktemp("served")
    write_stream(folder / "stream.morgs", 1)
    viewer = Viewer(folder, ViewerConfig(port=0, allowed_names=("lab.example",)))
    thread = Thread(target=viewer.run)
    thread.start()
    yield "127.0.0.1", int(viewer.url.rpartition(":")[2])
    viewer.stop()
    thread.join(20)
    assert not thread.is_alive()


def answer(address: tuple[str, int], *headers: str) -> str:
    """Return the first line and the body of the answer to a hand-made request."""
    lines = ["GET / HTTP/1.1", *(header.replace("PORT", str(address[1])) for header in headers)]
    with socket.create_connection(address, timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        received = b""
        while b"\r\n\r\n" not in received and (more := connection.recv(4096)):
            received += more
        while b"HTTP/1.1 403" in received and (more := connection.recv(4096)):
            received += more
    head, _, body = received.partition(b"\r\n\r\n")
    return head.split(b"\r\n")[0].decode() + " " + body.decode(errors="replace")


def handshake(address: tuple[str, int], *headers: str) -> str:
    import viser

    key = base64.b64encode(os.urandom(16)).decode()
    upgrade = ("Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13")
    return answer(address, *headers, *upgrade, f"Sec-WebSocket-Protocol: viser-v{viser.__version__}")


@pytest.mark.parametrize("host", ["127.0.0.1:PORT", "localhost:PORT", "lab.example:PORT"])
def test_viewer__accepts_its_own_page(address, host):
    assert handshake(address, f"Host: {host}", f"Origin: http://{host}").startswith("HTTP/1.1 101 ")
    assert answer(address, f"Host: {host}").startswith("HTTP/1.1 200 ")


@pytest.mark.parametrize(
    ("headers", "message"),
    [
        (("Host: localhost:PORT", "Origin: https://evil.example"), "from 'https://evil.example'"),
        (("Host: evil.example:PORT", "Origin: http://evil.example:PORT"), "add --allowed-names evil.example"),
    ],
)
def test_viewer__refuses_other_pages_and_rebound_names(address, headers, message):
    refused = handshake(address, *headers)
    assert refused.startswith("HTTP/1.1 403 ")
    assert message in refused
    assert answer(address, *headers).startswith("HTTP/1.1 403 ")


@pytest.mark.parametrize(("host", "is_public"), [("0.0.0.0", True), ("127.0.0.1", False)])
def test_view__reports_that_other_machines_can_open_the_page(tmp_path, monkeypatch, capsys, host, is_public):
    pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")
    write_stream(tmp_path / "stream.morgs", 1)
    run = Viewer.run
    monkeypatch.setattr(Viewer, "run", lambda viewer: (viewer.stop(), run(viewer)))
    assert cli.main(["view", str(tmp_path), "--host", host, "--port", "0", "--no-open-browser"]) == 0
    output = capsys.readouterr().out
    assert ("without a password" in output) == is_public
    assert f"http://{'localhost' if is_public else host}:" in output
