"""Time the viewer in headless Chromium: from the start of its process to the first Gaussians, and bytes per frame.

    python -m benchmarks.speed.viewer --json out.json

The stream is that of `benchmarks.speed.web_player`: a ball of Gaussians with SH of degree 1, some of which, chosen at
random, change in every attribute of every frame. The browser already runs and opens the page as soon as the viewer
listens; the Gaussians count as drawn when they are on a screenshot. Bytes are those that the page receives after the
next frame was requested. The browser draws without a GPU, on the processor that also decodes.
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
from statistics import median
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import tyro
from playwright.sync_api import Page, sync_playwright

from benchmarks.speed.output import Output
from benchmarks.speed.web_player import FLAGS, write_clip

SIZE = {"width": 640, "height": 360}
# The page's left half, which its controls do not cover.
SEEN = {"x": 0, "y": 60, "width": 320, "height": 240}
# Brightness and share of pixels from which Gaussians count as drawn.
BRIGHT, SHARE = 60, 0.1


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


def is_drawn(page: Page) -> bool:
    """Return whether a screenshot shows Gaussians."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(clip=SEEN), np.uint8), cv2.IMREAD_COLOR)
    return float((image.max(axis=2) > BRIGHT).mean()) > SHARE


def is_served(port: int) -> bool:
    """Return whether a server listens."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def free_port() -> int:
    """Return a port that no server has."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def start(folder: Path, page: Page, frames: int, active: int) -> dict[str, Any]:
    """Start the viewer, wait for the first Gaussians, step through the frames, and return the figures."""
    port, traffic, times = free_port(), Traffic(), {}
    traffic.watch(page)
    command = [sys.executable, "-m", "morgs_mi", "view", str(folder), "--port", str(port), "--no-open-browser"]
    begin = time.perf_counter()
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not is_served(port):
            time.sleep(0.005)
        times["listening"] = time.perf_counter() - begin
        page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1", wait_until="commit")
        while not is_drawn(page):
            page.wait_for_timeout(10)
        times["drawn"] = time.perf_counter() - begin
        page.get_by_text("Frame 0 of").wait_for()
        page.wait_for_timeout(2000)
        first, sizes = sum(traffic.sizes), []
        for frame in range(1, frames):
            traffic.sizes.clear()
            page.keyboard.press("l")
            page.get_by_text(f"Frame {frame} of").wait_for()
            page.wait_for_timeout(1000)
            sizes.append(sum(traffic.sizes))
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(20)
    return {
        "listening_s": round(times["listening"], 2),
        "first_splats_s": round(times["drawn"], 2),
        "connection_to_splats_s": round(times["drawn"] - times["listening"], 2),
        "first_screen_bytes": first,
        "frame_bytes": sizes,
        "frame_bytes_median": round(median(sizes)),
        "changed_bytes": 32 * active,
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
            load = os.getloadavg()[0]
            starts.append({**start(Path(folder), page, options.frames, active), "load_average": round(load, 1)})
            page.close()
        return starts


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    starts = measure(options)
    options.write({"gaussians": options.gaussians, "active": options.active, "starts": starts}, packages=["viser"])


if __name__ == "__main__":
    main()
