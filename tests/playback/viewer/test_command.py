"""`morgs-mi view`."""

import html
import json
import os
import re
import signal
import socket
import subprocess
import sys
import webbrowser
from threading import Thread
from urllib.parse import parse_qs, urlsplit

import pytest

from morgs_mi.cli.main import main
from morgs_mi.playback.viewer.server import Viewer
from tests.playback.viewer.serving import exact, get
from tests.scenes.changing_splats import rig
from tests.scenes.programs import run_script


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
