"""Time the viewer in headless Chromium: from the start of its process to the first Gaussians, and bytes per frame.

    python -m benchmarks.speed.viewer --json out.json

The stream is that of `benchmarks.speed.web_player`: a ball of Gaussians with SH of degree 1, some of which, chosen at
random, change in every attribute of every frame. The browser already runs and opens the page as soon as the viewer
listens. The first Gaussians are timed when the page draws all of them; the drawing itself depends on the GPU and is
left out. Bytes are those that the page receives by its WebSocket until a second after it shows the next frame.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import tyro
from playwright.sync_api import Page, sync_playwright

from benchmarks.speed.output import Output
from benchmarks.speed.web_player import FLAGS, write_clip

SIZE: Any = {"width": 640, "height": 360}
# Note the time at which all Gaussians are first drawn, in place of drawing them.
NOTE_DRAWING = """(count) => {
  const { prototype } = WebGL2RenderingContext;
  const draw = prototype.drawElementsInstanced;
  prototype.drawElementsInstanced = function (mode, indices, type, offset, instances) {
    if (instances < count) return draw.call(this, mode, indices, type, offset, instances);
    window.drawnAt ??= performance.timeOrigin + performance.now();
  };
}"""


@dataclass(frozen=True)
class Options(Output):
    """Time the viewer in headless Chromium."""

    gaussians: int = 200_000
    """Number of Gaussians."""
    active: float = 0.05
    """Fraction of them that changes in every frame."""
    frames: int = 12
    """Number of frames."""
    repeats: int = 3
    """Number of starts."""
    chromium: str = shutil.which("chromium") or "chromium"
    """The browser."""


@dataclass
class Traffic:
    """What a page receives by its WebSocket."""

    sizes: list[int] = field(default_factory=list)

    def watch(self, page: Page) -> None:
        """Count the frames of the page's WebSockets."""
        count = lambda data: self.sizes.append(len(data))  # noqa: E731
        page.on("websocket", lambda websocket: websocket.on("framereceived", count))


def is_served(port: int) -> bool:
    """Return whether a server listens."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def free_port() -> int:
    """Return a port that no server has."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def start(folder: Path, page: Page, options: Options) -> dict[str, Any]:
    """Start the viewer, wait for the first Gaussians, step through the frames, and return the figures."""
    port, traffic, sizes = free_port(), Traffic(), []
    traffic.watch(page)
    page.add_init_script(f"({NOTE_DRAWING})({options.gaussians})")
    command = [sys.executable, "-m", "morgs_mi", "view", str(folder), "--port", str(port), "--no-open-browser"]
    begin, load = time.time(), os.getloadavg()[0]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not is_served(port):
            time.sleep(0.005)
        served = time.time()
        page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1", wait_until="commit")
        drawn = page.wait_for_function("window.drawnAt").json_value() / 1e3
        page.get_by_text("Frame 0 of").wait_for()
        page.wait_for_timeout(2000)
        first = sum(traffic.sizes)
        for frame in range(1, options.frames):
            traffic.sizes.clear()
            page.keyboard.press("l")
            page.get_by_text(f"Frame {frame} of").wait_for()
            page.wait_for_timeout(1000)
            sizes.append(sum(traffic.sizes))
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(20)
    return {
        "start_to_page_s": round(served - begin, 2),
        "page_to_gaussians_s": round(drawn - served, 2),
        "start_to_gaussians_s": round(drawn - begin, 2),
        "first_screen_bytes": first,
        "frame_bytes": sizes,
        "load_average": round(load, 1),
    }


def measure(options: Options) -> list[dict[str, Any]]:
    """Return the figures of every start."""
    active = round(options.active * options.gaussians)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        write_clip(Path(folder) / "stream.morgs", options.gaussians, active, options.frames)
        browser = driver.chromium.launch(executable_path=options.chromium, args=FLAGS)
        starts = []
        for _ in range(options.repeats):
            page = browser.new_page(viewport=SIZE)
            page.set_default_timeout(120_000)
            starts.append(start(Path(folder), page, options))
            page.close()
        return starts


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    figures = {
        "gaussians": options.gaussians,
        "active": options.active,
        "bytes_of_all": 32 * options.gaussians,
        "bytes_of_active": round(32 * options.active * options.gaussians),
        "starts": measure(options),
    }
    options.write(figures, packages=["viser", "playwright"])


if __name__ == "__main__":
    main()
