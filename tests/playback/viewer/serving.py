"""A viewer in a thread, and requests to it."""

import json
import socket
from contextlib import contextmanager
from http.client import HTTPConnection
from threading import Thread
from urllib.parse import urlencode, urlsplit

import cv2
import numpy as np

from morgs_mi.codec.container import header_json
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.viewer.server import Viewer


@contextmanager
def viewing(path, **options):
    """Serve a stream, or a file of Gaussians, and yield the link."""
    viewer = Viewer(open_stream(path), **options)
    thread = Thread(target=viewer.run)
    thread.start()
    try:
        yield viewer.url
    finally:
        viewer.stop()
        thread.join(60)
        assert not thread.is_alive()


def get(url, path="", **headers):
    """Return the answer to a request, and its content; the path is sent as it is."""
    parts = urlsplit(url)
    connection = HTTPConnection("127.0.0.1", parts.port, timeout=120)
    connection.request(
        "GET",
        parts.path + path,
        headers={name.replace("_", "-"): headers[name] for name in headers},
    )
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content


def raw(url, *lines):
    """Return the first line and the body of the answer to hand-made lines."""
    with socket.create_connection(("127.0.0.1", urlsplit(url).port), timeout=60) as connection:
        connection.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
        answer = b"".join(iter(lambda: connection.recv(4096), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    return head.split(b"\r\n")[0].decode() + " " + body.decode(errors="replace")


def exact(frame, channel, camera, scale=10):
    """Return the path of an exact image."""
    fields = json.loads(header_json([camera], 25, {}))["cameras"][0]
    return f"exact/{frame}/{channel}?{urlencode({'camera': json.dumps(fields), 'scale': scale})}"


def decoded(content):
    """Return the RGB image in a file."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), 1)
    return image[..., ::-1]
