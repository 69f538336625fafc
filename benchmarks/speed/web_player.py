"""Time the web player in headless Chromium: decoding a frame, and sorting its Gaussians.

    python -m benchmarks.speed.web_player --json out.json

A ball of Gaussians as for the renderer, with SH of degree 1 and a confidence. The same ones change in every attribute
of every frame, by about a pixel and by some percent; nothing is born and nothing dies. Decoding, which includes the
conversion to the renderer's numbers, and sorting run in workers of the page. Decoding is timed in its worker, sorting
from the request to the answer. Drawing depends on the GPU and is not timed.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import mitsuba as mi
import numpy as np
import tyro
from playwright.sync_api import Page, sync_playwright

from benchmarks.speed.codec_speed import depths
from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, residual_packet
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.export.web import write_web_page
from morgs_mi.playback.player import open_stream

WARM_UP = 20
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Sort the depths of a frame, which Spark has read back from the GPU, as it does for every frame.
TIME_SORTING = """async (repeats) => {
  const { spark } = player.splats;
  const depths = spark.readback32.slice();
  const times = [];
  for (let i = 0; i < repeats; i++) {
    const { numSplats } = spark.current;
    const request = { numSplats, readback: depths.slice(), ordering: new Uint32Array(spark.maxSplats) };
    const start = performance.now();
    const { activeSplats } = await spark.sortWorker.call("sortSplats32", request);
    times.push(performance.now() - start);
    if (activeSplats < numSplats / 2) throw new Error(`only ${activeSplats} were sorted`);
  }
  return times;
}"""


@dataclass(frozen=True)
class Options(Output):
    """Time the web player in headless Chromium."""

    gaussians: int = 200_000
    """Number of Gaussians."""
    active: float = 0.1
    """Fraction of them that changes in every frame."""
    frames: int = 60
    """Number of frames; the first twenty warm up."""
    chromium: str = shutil.which("chromium") or "chromium"
    """The browser."""


def write_clip(path: Path, count: int, active: int, frames: int) -> None:
    """Write the stream."""
    gaussians, camera = ball(0, count, 1352, 1014, 0.01, sh_degree=1)
    confidence = np.where(np.arange(count) < active, 3, -3) + np.random.default_rng(1).normal(0, 0.5, count)
    gaussians = replace(gaussians, logit_confidence=np.random.default_rng(2).permutation(confidence))
    pixel = float(np.median(depths(gaussians, camera)) / camera.K[0, 0])
    rng, state, packet = np.random.default_rng(0), None, keyframe_packet(gaussians, 0, [camera])
    with StreamWriter(path, [camera], 30) as writer:
        for _ in range(frames):
            writer.write(packet)
            state = decode(state, packet)
            raw = {name: value.copy() for name, value in state.gaussians.numpy().items() if name != "motion"}
            rows = np.flatnonzero(raw["logit_confidence"] > 0)
            for name, value in raw.items():
                step = pixel if name == "means" else 0.03
                value[rows] += rng.normal(0, step, value[rows].shape).astype(value.dtype)
            packet = residual_packet(state, Gaussians(**raw), None, [camera])


def wait(page: Page, condition: str) -> None:
    """Wait until a condition of the page is true."""
    while not page.evaluate(condition):
        page.wait_for_timeout(50)


def measure(options: Options) -> dict[str, Any]:
    """Return the figures."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        stream, html = Path(folder) / "clip.morgs", Path(folder) / "clip.html"
        write_clip(stream, options.gaussians, round(options.active * options.gaussians), options.frames)
        write_web_page(open_stream(stream), html)
        browser = driver.chromium.launch(executable_path=options.chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 40, "height": 30})
        page.goto(html.as_uri() + "#pause")
        wait(page, "!!window.player && player.settled")
        sorting = page.evaluate(TIME_SORTING, options.frames)
        page.evaluate("player.splats.draw = () => {}")
        for frame in range(1, options.frames):
            page.evaluate(f"player.playback.seek({frame})")
            wait(page, f"player.playback.position === {frame}")
        decoding = page.evaluate("player.playback.decodeTimes")
        return {
            "gaussians": options.gaussians,
            "active": options.active,
            "keyframe_ms": round(decoding[0], 1),
            "decode_ms": round(median(decoding[WARM_UP:]), 1),
            "decode_least_ms": round(min(decoding[WARM_UP:]), 1),
            "sort_ms": round(median(sorting[WARM_UP:]), 1),
            "sort_least_ms": round(min(sorting[WARM_UP:]), 1),
            "stream_bytes": stream.stat().st_size,
            "page_bytes": html.stat().st_size,
            "browser": browser.version,
            "load_average": round(os.getloadavg()[0], 1),
        }


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    options.write({"player": measure(options), "seed": 0}, packages=["playwright"])


if __name__ == "__main__":
    main()
