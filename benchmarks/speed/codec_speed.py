"""Time the stream's encoder and decoder on frames in which some Gaussians move.

    python -m benchmarks.speed.codec_speed --json out.json

A ball of Gaussians as for the renderer, with SH of degree 1 and a confidence. The moving ones change in every
attribute, by about a pixel and by some percent. One percent of all are removed and as many are added. The figures
include the bytes and the quantisation error of the means on screen.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi import Camera, Gaussians
from morgs_mi.codec.container import decode_packet, encode_packet
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, residual_packet

# Number of Gaussians, number of moving ones.
LADDER = ((20_000, 10_000), (200_000, 10_000), (200_000, 200_000))


@dataclass(frozen=True)
class Options(Output):
    """Time the stream's encoder and decoder."""

    sizes: tuple[tuple[int, int], ...] = LADDER
    """Pairs of the number of Gaussians and the number of moving ones."""
    repeats: int = 7
    """Number of runs, after one warm-up; medians are reported."""


def change(gaussians: Gaussians, moving: int, pixel: float) -> tuple[Gaussians, np.ndarray]:
    """Return the next frame and the index of each of its Gaussians in the last one (`source`), -1 for new ones."""
    rng, N = np.random.default_rng(0), len(gaussians)
    raw = {name: value.copy() for name, value in gaussians.numpy().items() if name != "motion"}
    chosen = rng.permutation(N)[:moving]
    for name, value in raw.items():
        value[chosen] += rng.normal(0, pixel if name == "means" else 0.03, value[chosen].shape).astype(value.dtype)
    now, births = Gaussians(**raw), N // 100
    survivors = np.sort(rng.permutation(N)[births:])
    source = np.concatenate([survivors, np.full(births, -1)])
    return now.select(np.concatenate([survivors, np.arange(births)])), source


def measure(count: int, moving: int, repeats: int) -> dict[str, Any]:
    """Return the figures of one size."""
    gaussians, camera = ball(0, count, 1352, 1014, 0.01, sh_degree=1)
    gaussians = replace(gaussians, logit_confidence=np.random.default_rng(1).normal(0, 2, count))
    before = decode(None, keyframe_packet(gaussians, 0, [camera]))
    now, source = change(before.gaussians, moving, float(np.median(depths(before.gaussians, camera)) / camera.K[0, 0]))
    encode_ms, decode_ms, data, after = [], [], b"", before
    for _ in range(repeats + 1):
        # A new value has no cached digest.
        parent = CodedFrame(before.frame, before.grid, before.ids, before.next_id, before.gaussians)
        start = time.perf_counter()
        data = encode_packet(residual_packet(parent, now, source, [camera]))
        encoded = time.perf_counter()
        after = decode(parent, decode_packet(data))
        encode_ms.append(1e3 * (encoded - start))
        decode_ms.append(1e3 * (time.perf_counter() - encoded))
    off = np.linalg.norm(np.asarray(after.gaussians.means) - np.asarray(now.means), axis=1)
    pixels = off * camera.K[0, 0] / depths(now, camera)
    return {
        "gaussians": count,
        "moving": moving,
        "encode_ms": round(median(encode_ms[1:]), 1),
        "decode_ms": round(median(decode_ms[1:]), 1),
        "bytes": len(data),
        "error_px_rms": float(f"{np.sqrt(np.mean(pixels**2)):.3g}"),
        "error_px_max": float(f"{pixels.max():.3g}"),
    }


def depths(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the depths [N] of the means along the camera's axis."""
    return np.asarray(gaussians.means) @ camera.viewmat[2, :3] + camera.viewmat[2, 3]


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    rows = [measure(count, moving, options.repeats) for count, moving in options.sizes]
    options.write({"rows": rows, "seed": 0})


if __name__ == "__main__":
    main()
