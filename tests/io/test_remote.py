"""Captures at URLs: they read like a folder, and only what is decoded is fetched."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import load_capture
from morgs_mi.io.remote import fetched, is_url, mirrored, url_of
from tests.scenes.recording import write_recording

fsspec = pytest.importorskip("fsspec", reason="comes with the extra `cluster`")
URL = "memory://bucket/clip"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A capture in a folder, which is also at the URL."""
    folder = write_recording(tmp_path / "clip", 8)
    system = fsspec.filesystem("memory")
    (folder / "truth").mkdir()
    (folder / "truth" / "much.npz").write_bytes(bytes(10))
    system.put(str(folder), "/bucket/clip", recursive=True)
    yield folder
    system.rm("/bucket", recursive=True)


def test_load_capture__reads_a_url_like_a_folder(folder: Path) -> None:
    local = load_capture(folder)
    remote = load_capture(URL)
    assert (remote.names, remote.num_frames, remote.path.name) == (
        local.names,
        local.num_frames,
        "clip",
    )
    np.testing.assert_array_equal(remote.points, local.points)
    for ours, theirs in zip(remote.frames(), local.frames(), strict=True):
        np.testing.assert_array_equal(ours.images, theirs.images)


def test_load_capture__fetches_only_the_images_that_it_decodes(folder: Path) -> None:
    capture = load_capture(URL)
    list(capture.frames(2, 4))
    files = sorted((capture.path / capture.names[0]).glob("*.png"))
    # Those at the start, in the middle and at the end are looked at for transparent pixels.
    assert [k for k, file in enumerate(files) if file.stat().st_size] == [0, 2, 3, 4, 7]
    assert not (capture.path / "truth").exists()


def test_mirrored__fetches_nothing_twice_until_the_capture_changes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = load_capture(URL)
    with monkeypatch.context() as broken:
        broken.setattr(type(fsspec.filesystem("memory")), "get_file", None)
        assert load_capture(URL).path == first.path
    with fsspec.open(f"{URL}/capture.json", "w") as file:
        file.write('{"fps": 5}')
    assert load_capture(URL).fps == 5


def test_url_of__is_that_of_a_mirrored_folder(folder: Path) -> None:
    assert url_of(mirrored(URL)) == URL
    assert url_of(folder) is None
    assert is_url(URL)
    assert not is_url(str(folder))


def test_fetched__leaves_empty_files_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "0.png").touch()
    assert fetched(tmp_path / "0.png").stat().st_size == 0


class Refusing(fsspec.AbstractFileSystem):
    """A file system that refuses to list its files."""

    protocol = "refusing"
    error = PermissionError("Access Denied")

    def ls(self, path, detail=True, **options):
        raise self.error


class Silent(Refusing):
    protocol = "silent"
    error = TimeoutError()


@pytest.mark.parametrize(
    ("url", "kind", "message"),
    [
        (
            "nothing://a/b",
            ValueError,
            r"nothing://a/b: expected a URL that fsspec can open, .*not known: nothing",
        ),
        ("s3://a/b", ValueError, r"s3://a/b: reading it needs another package: Install s3fs"),
        (
            "memory://none",
            FileNotFoundError,
            r"memory://none: expected a file or a folder, found none",
        ),
        (
            "refusing://a",
            PermissionError,
            r"refusing://a: expected to be allowed to read it, got Access Denied",
        ),
        ("silent://a", ConnectionError, r"silent://a: expected an answer, got none in time"),
    ],
)
def test_mirrored__refuses_in_one_sentence(
    url, kind, message, monkeypatch: pytest.MonkeyPatch
) -> None:
    for system in (Refusing, Silent):
        fsspec.register_implementation(system.protocol, system, clobber=True)
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(kind, match=message):
        mirrored(url)


def test_mirrored__names_the_extra_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(
        ValueError,
        match=r"memory://a: reading it needs the package fsspec; pip .*morgs-mi\[cluster\]",
    ):
        mirrored("memory://a")


def test_fetched__names_a_file_that_has_gone(folder: Path) -> None:
    capture = load_capture(URL)
    fsspec.filesystem("memory").rm("/bucket/clip/cam1/0002.png")
    with pytest.raises(
        FileNotFoundError,
        match=r"memory://bucket/clip: /bucket/clip/cam1/0002\.png: expected a file",
    ):
        list(capture.frames(2, 3))


def test_fit__names_an_unknown_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fit", "nothing://a/b", str(tmp_path / "out")]) == 1
    assert "nothing://a/b: expected a URL that fsspec can open" in " ".join(
        capsys.readouterr().err.split()
    )


class Server(ThreadingHTTPServer):
    """An HTTP server of a folder.

    Attributes:
        versions: header fields of every file that has its time, e.g. ``ETag``.
        instead: body that is sent once in place of a file, by the end of its path; None: it is
            never finished.
        fetched: paths of the requested bodies.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.versions: tuple[str, ...] = ("Last-Modified",)
        self.instead: dict[str, bytes | None] = {}
        self.fetched: list[str] = []
        self.stop = threading.Event()
        self.url = f"http://127.0.0.1:{self.server_port}/clip"


class Handler(SimpleHTTPRequestHandler):
    server: Server

    def log_message(self, *args) -> None: ...

    def send_header(self, keyword: str, value: str) -> None:
        if keyword != "Last-Modified":
            super().send_header(keyword, value)
            return
        for name in self.server.versions:
            super().send_header(name, value)  # a time is a good ETag, too

    def do_GET(self) -> None:
        if Path(self.path).suffix:
            self.server.fetched.append(self.path)
        end = next((end for end in self.server.instead if self.path.endswith(end)), None)
        if end is None:
            super().do_GET()
            return
        body = self.server.instead.pop(end)
        self.send_response(200)
        self.send_header("Content-Length", str(1000 if body is None else len(body)))
        self.end_headers()
        if body is None:
            self.wfile.write(b"half")
            self.wfile.flush()
            self.server.stop.wait(20)
        else:
            self.wfile.write(body)


@pytest.fixture
def server(tmp_path: Path, cache: Path) -> Iterator[Server]:
    pytest.importorskip("aiohttp", reason="comes with the extra `cluster`")
    write_recording(tmp_path / "clip", 2)
    with Server(tmp_path) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield server
        server.stop.set()
        server.shutdown()
        thread.join()


def first_images(url: str) -> list[np.ndarray]:
    return list(next(iter(load_capture(url, max_frames=1).frames())).images)


@pytest.mark.parametrize("versions", [("Last-Modified",), ("ETag",), ("ETag", "Last-Modified"), ()])
def test_mirrored__reuses_http_files_only_while_their_versions_are_equal(
    server: Server, tmp_path, versions
) -> None:
    server.versions = versions
    focal_length = load_capture(server.url).cameras[0].K[0, 0]
    server.fetched.clear()
    assert load_capture(server.url).cameras[0].K[0, 0] == focal_length
    assert bool(server.fetched) == (not versions)
    file = tmp_path / "clip" / "sparse" / "0" / "cameras.txt"
    text = file.read_text()
    old = f" {focal_length:g}"[:2]
    # As many bytes as before.
    file.write_text(text.replace(f"PINHOLE 32 24{old}", "PINHOLE 32 24 9"))
    os.utime(file, (1e9, 1e9))
    assert load_capture(server.url).cameras[0].K[0, 0] > 90


PAGE = b"<!DOCTYPE html><html><body>Log in"


def test_mirrored__leaves_out_no_folder_that_cannot_be_listed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = type(fsspec.filesystem("memory"))
    whole = system.ls

    def ls(self, path, detail=True, **options):
        if path.endswith("cam1"):
            raise TimeoutError
        return whole(self, path, detail, **options)

    with monkeypatch.context() as stalled:
        stalled.setattr(system, "ls", ls)
        with pytest.raises(
            ConnectionError, match="memory://bucket/clip: expected an answer, got none in time"
        ):
            mirrored(URL)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "body", "kind", "message"),
    [
        (
            "0000.png",
            PAGE,
            ConnectionError,
            "expected a file, got a page of HTML; check the URL, or log in",
        ),
        ("cameras.txt", PAGE, ConnectionError, "cameras.txt: expected a file, got a page of HTML"),
        (
            "cameras.txt",
            b"# Camera list\n",
            ConnectionError,
            r"expected \d+ bytes, got 14; it has changed or was cut",
        ),
        (
            "0000.png",
            None,
            ConnectionError,
            "0000.png: expected an answer, got none in time; check the connection",
        ),
    ],
)
def test_fetched__keeps_no_wrong_answer(
    server: Server, monkeypatch, name, body, kind, message
) -> None:
    monkeypatch.setattr("morgs_mi.io.remote.PATIENCE", 2)
    server.instead[name] = body
    with pytest.raises(kind, match=message):
        first_images(server.url)
    assert not server.instead
    assert len(first_images(server.url)) == 3
