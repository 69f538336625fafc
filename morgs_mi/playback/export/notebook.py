"""Streams in notebooks: a player in the output of a cell, or an image where the stream is too long
for one.
"""

from __future__ import annotations

import base64
import html

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.color_space import exposed
from morgs_mi.core.png import png_bytes
from morgs_mi.playback.export.web import web_page
from morgs_mi.playback.player import channel_image, render
from morgs_mi.playback.stream_header import render_config, stream_exposure, stream_name

# Largest stream that is stored in a notebook, in bytes; the player adds a bit more than a megabyte.
LARGEST = 4_000_000
# Width and height of the player in pixels, unless the output of the cell is narrower.
_WIDTH = 800
_HEIGHT = 600
_STYLE = "width:100%;max-width:{width:.0f}px;aspect-ratio:{aspect:.4f};border:0;border-radius:8px"
_PLAYER = (
    '<iframe sandbox="allow-scripts" allow="fullscreen" title="{title}" style="{style}" '
    'srcdoc="{page}"></iframe>'
)
_POSTER = '<img alt="{title}" style="{style}" src="data:image/png;base64,{image}"><div>{text}</div>'


def stream_html(stream: FrameSource) -> str:
    """Return a stream as HTML: the player of `morgs-mi export web`, or the first frame where it
    would be too large.

    A stream that cannot be read becomes the sentence that describes why.
    """
    try:
        camera = stream.cameras[0]
        size = stream.path.stat().st_size
        aspect = camera.width / camera.height
        style = _STYLE.format(width=min(_WIDTH, _HEIGHT * aspect), aspect=aspect)
        title = html.escape(stream_name(stream))
        if size <= LARGEST:
            page = web_page(stream).decode().replace("&", "&amp;").replace('"', "&quot;")
            return _PLAYER.format(title=title, style=style, page=page)
        gaussians = next(gaussians for _, gaussians in play(stream))
        color = render(gaussians, camera, ("color",), render_config(stream))["color"]
        picture = channel_image("color", exposed(color, stream_exposure(stream)))
        image = base64.b64encode(png_bytes(picture)).decode()
    except (OSError, ValueError, StopIteration) as error:
        message = str(error) or f"{stream.path}: expected at least one frame, got none."
        return f"<div>{html.escape(message)}</div>"
    command = html.escape(f"morgs-mi export web {stream.path} page.html")
    text = f"Frame 0 of {size / 1e6:.0f} MB. To play it, write a page with <code>{command}</code>."
    return _POSTER.format(title=title, style=style, image=image, text=text)
