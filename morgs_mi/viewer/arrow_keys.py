"""The arrow keys of the page: left and right change the frame.

viser turns the camera with the arrows, and its commands cannot have them as keys. So a script in its page passes them
on as the keys of the commands for the previous and the next frame.
"""

from __future__ import annotations

import gzip
from typing import Any

__all__ = ["NEXT", "PREVIOUS", "with_arrow_keys"]

PREVIOUS, NEXT = "J", "L"
"""Keys of the commands for the previous and the next frame."""
# In the capture phase of the window, before viser's own listeners. A control with the focus keeps its keys.
_SCRIPT = f"""<script>
window.addEventListener("keydown", (event) => {{
  const key = {{ ArrowLeft: "{PREVIOUS}", ArrowRight: "{NEXT}" }}[event.key];
  const modified = event.ctrlKey || event.altKey || event.metaKey || event.shiftKey;
  if (!key || modified || event.target.closest?.("input, textarea, [role=slider], [contenteditable]")) return;
  event.stopImmediatePropagation();
  event.preventDefault();
  const passed = {{ key: key.toLowerCase(), code: "Key" + key, bubbles: true }};
  event.target.dispatchEvent(new KeyboardEvent("keydown", passed));
}}, true);
</script>"""


def with_arrow_keys(response: Any) -> Any:
    """Return viser's response to a request with the script in it if it is the page.

    Args:
        response: a `Response` of websockets, None for a connection to the WebSocket.
    """
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    is_compressed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if is_compressed else response.body
    body = body.replace(b"<head>", b"<head>" + _SCRIPT.encode(), 1)
    response.body = gzip.compress(body) if is_compressed else body
    del response.headers["Content-Length"]  # headers are a multidict: setting would add a second one
    response.headers["Content-Length"] = str(len(response.body))
    return response
