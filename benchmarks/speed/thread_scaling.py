"""Time the stages of a later frame on some numbers of threads, with the serial share of each (Amdahl 1967).

    python -m benchmarks.speed.thread_scaling --threads 1 2 --json thread_scaling.json

The scene is that of `frame_speed`. With T_n seconds on n threads, the share that does not get faster is
(n T_n / T_1 - 1) / (n - 1).
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.frame_speed import SIZES, Scene, config_of, measure
from benchmarks.speed.output import Output


@dataclass(frozen=True)
class Options(Output):
    """Work and output."""

    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads; the first must be 1."""
    size: str = "n3dv"
    """Size of the rig, small or n3dv."""
    frames: int = 3
    """Number of later frames; the first is warm-up, medians of the others are reported."""
    epochs: int = 2
    """Epochs of a later frame."""
    seed: int = 0
    """Seed of scene and noise."""


def fit_on(count: int, options: Options) -> dict[str, float]:
    """Return the seconds of a later frame and of its stages on `count` cores; called in a process of its own."""
    # Before Dr.Jit and OpenCV start their threads, one per usable core.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    mi.set_variant("llvm_ad_rgb")
    scene = Scene(SIZES[options.size], options.seed)
    config = config_of(scene.size, epochs=options.epochs)
    row = measure(scene, config, scene.recorded(options.frames + 2, options.seed))
    return {name: value for name, value in row.items() if name == "seconds" or name.endswith("_s")}


def serial_shares(seconds: dict[int, dict[str, float]]) -> dict[str, float]:
    """Return the serial share of each stage, from the largest number of threads; 0 for stages that take no time."""
    n = max(seconds)
    ratios = {name: seconds[n][name] / first for name, first in seconds[1].items() if first > 0.01}
    return {name: float(f"{np.clip((n * ratio - 1) / (n - 1), 0, 1):.2g}") for name, ratio in ratios.items()}


def main(options: Options) -> None:
    """Run the benchmark."""
    available = len(os.sched_getaffinity(0))
    if options.threads[0] != 1 or not 1 < max(options.threads) <= available:
        raise SystemExit(f"--threads: expected 1 and numbers up to {available}, got {options.threads}.")
    seconds = {}
    for count in options.threads:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            seconds[count] = process.submit(fit_on, count, options).result()
        print(f"{count:3d} threads: {seconds[count]['seconds']:.2f} s", flush=True)
    mi.set_variant("llvm_ad_rgb")
    figures = {"size": vars(SIZES[options.size]), "epochs": options.epochs, "seconds": seconds}
    options.write({**figures, "serial_share": serial_shares(seconds)}, unprinted=["size"])


if __name__ == "__main__":
    main(tyro.cli(Options))
