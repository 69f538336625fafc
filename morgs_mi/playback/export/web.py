"""A stream as a web page that plays it: one file, a folder for a web server with a module for other
pages, or the output of a notebook's cell.

The page and the module are built from `web/` and part of the package. The page contains its script,
compressed, and in a single file the stream as well. Both are stored as text with 7 bits per
character (`text_of_bytes`).
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import re
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlencode

import numpy as np

from morgs_mi.codec.container import StreamWriter, header_json
from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.codec.packets import coded_frames
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import TRANSFER
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import seen_points
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.files import STREAM, atomic_folder, atomic_path
from morgs_mi.platform.png import jpeg_bytes
from morgs_mi.playback.default_rig import BOX, DEFAULT_RIG, box_corners
from morgs_mi.playback.export.clips import frame_numbers
from morgs_mi.playback.player import MOTION_SCALE, picture
from morgs_mi.playback.stream_header import (
    between_cameras,
    metadata_entry,
    num_frames,
    render_config,
    stream_box,
    stream_exposure,
    stream_name,
    stream_origin,
)

ImageReport = Callable[[int], None]

# What an HTML parser replaces (NUL, carriage return) or could take for the end of a script (<).
_UNSAFE = (0x00, 0x0D, 0x3C)
_MODULE = "morgs-spark.js"
_FOLDER = files("morgs_mi.playback.export") / "web_player"
# Gaussians per frame and camera from which the scale of the motion is estimated.
_SAMPLES = 500
# Smallest scale, as a fraction of the width per frame; with a smaller one, a still scene would show
# the fit's noise.
_LEAST_SCALE = 0.001
# Largest stream that is stored in a notebook, in bytes; the player adds a bit more than a megabyte.
LARGEST = 4_000_000
_LEAST_LOGIT = -2.0  # of the opacity of what the page frames, as `seen` in web/src/mesh.ts
_POSTER_WIDTH = 960  # pixels of the image until the first frame is shown
# Width and height of the player in pixels, unless the output of the cell is narrower.
_WIDTH = 800
_HEIGHT = 600
_STYLE = "width:100%;max-width:{width:.0f}px;aspect-ratio:{aspect:.4f};border:0;border-radius:8px"
_PLAYER = (
    '<iframe sandbox="allow-scripts" allow="fullscreen" title="{title}" style="{style}" '
    'srcdoc="{page}"></iframe>'
)
_POSTER = '<img alt="{title}" style="{style}" src="{image}"><div>{text}</div>'


def write_web_page(
    stream: FrameSource,
    path: str | Path,
    title: str | None = None,
    progress: ImageReport | None = None,
) -> int:
    """Write a self-contained page that plays a stream, and return its number of bytes.

    It is one HTML file that runs from a disk and requests nothing. Of the stream's metadata it has
    the renderer's settings alone; the scale of the motion is added.

    Args:
        stream: the file.
        path: the page.
        title: its title; by default the name of the stream's folder or file.
        progress: called with the number of frames that were checked.

    Raises:
        ValueError: a packet of the stream or its metadata is broken.
        OSError: the page cannot be written.
    """
    page = web_page(stream, title, progress)
    with atomic_path(path, "write_web_page()") as partial:
        partial.write_bytes(page)
    return len(page)


def web_page(
    stream: FrameSource, title: str | None = None, progress: ImageReport | None = None
) -> bytes:
    """Return the page that `write_web_page` writes; arguments and errors are the same."""
    data = _script("stream", published_bytes(stream, progress))
    return _page(stream, title, data, "data: blob:")


def write_web_folder(
    stream: FrameSource,
    path: str | Path,
    title: str | None = None,
    progress: ImageReport | None = None,
) -> int:
    """Write a folder for a web server and return its number of bytes.

    It contains the page `index.html`, the stream as a file, and `morgs-spark.js`, which plays it in
    other pages.

    Args:
        stream: the file.
        path: the new folder.
        title: as for `write_web_page`.
        progress: as for `write_web_page`.

    Raises:
        FileExistsError: `path` exists.
        ValueError: a packet of the stream or its metadata is broken.
        OSError: the folder cannot be written.
    """
    data = published_bytes(stream, progress)
    page = served_page(stream, title)
    contents = {"index.html": page, STREAM: data, _MODULE: (_FOLDER / _MODULE).read_bytes()}
    with atomic_folder(path, "write_web_folder()") as partial:
        for name, content in contents.items():
            (partial / name).write_bytes(content)
    return sum(map(len, contents.values()))


def stream_html(stream: FrameSource) -> str:
    """Return a stream as HTML: the player of `morgs-mi export web`, or the first frame where it
    would be too large.

    A stream that cannot be read becomes the sentence that describes why.
    """
    try:
        frame_numbers(stream)  # refuses a stream without frames
        camera = stream.cameras[0]
        size = stream.path.stat().st_size
        aspect = camera.width / camera.height
        style = _STYLE.format(width=min(_WIDTH, _HEIGHT * aspect), aspect=aspect)
        title = html.escape(stream_name(stream))
        if size <= LARGEST:
            page = web_page(stream).decode().replace("&", "&amp;").replace('"', "&quot;")
            return _PLAYER.format(title=title, style=style, page=page)
        image = first_image(stream)
    except (OSError, ValueError) as error:
        return f"<div>{html.escape(str(error))}</div>"
    command = html.escape(f"morgs-mi export web {stream.path} page.html")
    text = f"Frame 0 of {size / 1e6:.0f} MB. To play it, write a page with <code>{command}</code>."
    return _POSTER.format(title=title, style=style, image=image, text=text)


def first_image(stream: FrameSource) -> str:
    """Return the first frame of a stream, from its first camera, as the address of a JPEG."""
    gaussians = next(gaussians for _, gaussians in play(stream))
    image = base64.b64encode(jpeg_bytes(picture(stream, gaussians, _poster_camera(stream))))
    return f"data:image/jpeg;base64,{image.decode()}"


def _poster_camera(stream: FrameSource) -> Camera:
    camera = stream.cameras[0]
    return camera.with_width(min(_POSTER_WIDTH, camera.width))


def _exact_image(stream: FrameSource, frame: int) -> str:
    """Return the address at which a server of `playback.viewer` renders a frame from the first
    camera.
    """
    header = header_json([_poster_camera(stream)], stream.fps, {})
    camera = json.dumps(json.loads(header)["cameras"][0])
    return html.escape(f"exact/{frame}/color?{urlencode({'camera': camera, 'scale': 1})}")


def served_page(
    stream: FrameSource,
    title: str | None = None,
    server: str = "none",
    poster: int | None = None,
) -> bytes:
    """Return the page for a server that has the stream as a file.

    Args:
        stream: the file.
        title: its title; by default the name of the stream's folder or file.
        server: for the server of `playback.viewer`: ``recorded`` if it has recorded images, or
            ``exact``; ``none`` for any other.
        poster: frame that such a server renders until the page draws its first one; None: it has
            no frame yet.
    """
    place = f'<i id="stream" data-address="{STREAM}" hidden></i>'
    return _page(stream, title, place, "'self' data: blob:", server, poster)


def _first_paint(stream: FrameSource, server: str, poster: int | None) -> dict[str, str]:
    """Return what the page shows before its script runs, so that nothing moves then: what decides
    the controls, the colour behind everything, and the first frame where the first camera will be.
    A server of `playback.viewer` may have no frame yet.
    """
    camera = stream.cameras[0]
    corners = np.array([[0, 0], camera.size])
    if (box := stream_box(stream)) is not None:
        corners, _ = camera.project(box_corners(box))
    x, y = corners.min(axis=0)
    width, height = np.ptp(corners, axis=0)
    image = "data:,"
    motion = camera.width / 2
    frames = num_frames(stream)
    if server == "none":
        image = first_image(stream)
        motion = _motion_place(next(gaussians for _, gaussians in play(stream)), camera)
        frames = len(stream.frame_numbers())
    elif poster is not None and camera.background is None:  # the server renders over colours alone
        image = _exact_image(stream, poster)
    recorded = json.dumps(stream.metadata.get(DEFAULT_RIG) is not True)
    red, green, blue = render_config(stream).background or (0, 0, 0)
    between = html.escape(between_cameras(stream))
    return {
        "{kind}": (
            f'data-frames="{frames}" data-recorded="{recorded}" data-server="{server}" '
            f'data-between="{between}"'
        ),
        "{ground}": f"rgb({red:.1%} {green:.1%} {blue:.1%})",
        "{frame}": (
            f"--image-width: {camera.width}; --image-height: {camera.height}; --x: {x:.6g}; "
            f"--y: {y:.6g}; --width: {width:.6g}; --height: {height:.6g}; --motion: {motion:.6g}"
        ),
        "{image}": image,
    }


def _motion_place(gaussians: Gaussians, camera: Camera) -> float:
    """Return the median column of what is likely to move in the image of a camera; of an image
    without such, its middle.
    """
    raw = gaussians.numpy()
    moves = raw["logit_opacities"] > _LEAST_LOGIT
    moves &= raw.get("logit_confidence", np.zeros(1)) > 0
    _, pixels, _ = seen_points(camera, raw["means"][moves])
    return float(np.median(pixels[:, 0])) if len(pixels) else camera.width / 2


def text_of_bytes(data: bytes) -> str:
    """Return bytes as text with 7 bits per character, which HTML stores in a script without
    changing it.

    Bits are taken from the highest down, the last ones are filled up with zeros. 128 is added to
    the characters that HTML would change; a reader takes the low 7 bits of each. As UTF-8, the text
    is 1.17 times as long as random bytes; base64 is 1.33 times as long.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    septets = np.pad(bits, (0, -len(bits) % 7)).reshape(-1, 7)
    codes = np.packbits(septets, axis=1)[:, 0] >> 1
    return (codes + np.uint8(128) * np.isin(codes, _UNSAFE)).tobytes().decode("latin-1")


def published_bytes(stream: FrameSource, progress: ImageReport | None = None) -> bytes:
    """Return the stream with the metadata that the page reads, after decoding it once; errors as
    `write_web_page`.
    """
    frame_numbers(stream)  # refuses a stream without frames
    packets = list(stream)
    speeds = []
    for coded in coded_frames(packets):
        speeds.append(_speeds(coded.gaussians, stream.cameras))
        if progress is not None:
            progress(len(speeds))
    speeds, weights = np.hstack(speeds)
    scale = MOTION_SCALE
    if weights.any():
        # Not the maximum: a few Gaussians that the fit has lost are several times as fast as the
        # scene.
        scale = np.percentile(speeds, 99, weights=weights, method="inverted_cdf")
    metadata: JsonObject = {
        "config": {"render": metadata_entry(stream, "config.render")},
        "motion_scale": max(_LEAST_SCALE, float(scale)),
        "origin": stream_origin(stream).tolist(),
        DEFAULT_RIG: stream.metadata.get(DEFAULT_RIG) is True,
        BOX: stream.metadata.get(BOX),
    }
    if stops := stream_exposure(stream):
        metadata["transfer"] = {"name": TRANSFER, "display_exposure": stops}
    sink = io.BytesIO()
    with StreamWriter(sink, stream.cameras, stream.fps, metadata) as writer:
        for packet in packets:
            writer.write(packet)
    return sink.getvalue()


def _speeds(gaussians: Gaussians, cameras: Sequence[Camera]) -> np.ndarray:
    """Return speeds of moving Gaussians in the images of the cameras, and their weights there
    [2, S].

    A speed is a fraction of the image's width per frame. A weight is the opacity times the area on
    the screen.
    """
    motion = np.asarray(gaussians.motion)
    rows = np.flatnonzero(motion.any(axis=1))
    rows = rows[:: len(rows) // _SAMPLES + 1]
    raw = gaussians.numpy()
    means = raw["means"][rows]
    # A stream may contain any scale; the bound keeps the weights finite.
    log_sizes = np.minimum(raw["log_scales"][rows].mean(axis=1), 20)
    weights = np.asarray(gaussians.opacities)[rows] * np.exp(2 * log_sizes)
    views = []
    for camera in cameras:
        visible, _, depths = seen_points(camera, means)
        jacobians = camera.projection_jacobian(means[visible])
        motions = np.einsum("nij,nj->ni", jacobians, motion[rows][visible])
        speeds = np.linalg.norm(motions, axis=1) / camera.width
        views.append(np.stack([speeds, weights[visible] / depths**2]))
    return np.hstack(views)


def _page(
    stream: FrameSource,
    title: str | None,
    data: str,
    connect: str,
    server: str = "none",
    poster: int | None = None,
) -> bytes:
    code = gzip.compress((_FOLDER / "player.js").read_bytes(), 9, mtime=0)
    page = (_FOLDER / "player.html").read_text(encoding="utf-8")
    values = {
        "{version}": version("morgs-mi"),
        "{connect}": connect,
        "{title}": html.escape(title or stream_name(stream)),
        **_first_paint(stream, server, poster),
        "{notice}": (_FOLDER / "NOTICE").read_text(encoding="utf-8").replace("--", "- "),
        "{data}": data + "\n" + _script("code", code),
    }
    names = "|".join(map(re.escape, values))
    return re.sub(names, lambda match: values[match[0]], page).encode(errors="replace")


def _script(name: str, data: bytes) -> str:
    return (
        f'<script type="text/plain" id="{name}" '
        f'data-bytes="{len(data)}">{text_of_bytes(data)}</script>'
    )
