"""Count the machine instructions of the blending loops, their iterations and their speed.

    python -m benchmarks.speed.count_instructions --workload W1.npz W2b.npz --json out.json

Dr.Jit disassembles its kernels at log level Trace: a second process takes one step with an empty kernel cache and that
log level, and its listing is split into loops here. An iteration of such a loop blends one Gaussian into one block for
every lane of a SIMD packet (16 blocks with AVX-512). It needs an x86-64 processor and Dr.Jit's LLVM backend, and no
other program.

The instructions of an iteration are those of the body, each counted once; additions into the gradient, one per lane,
are counted as if all lanes were active. The inner loop to the next word of the list is counted separately.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks import workloads
from benchmarks.speed import timing
from benchmarks.speed.machine_code import counts, kernel_code, main_loop
from morgs_mi import Camera, Gaussians, RenderConfig
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.render import loops
from morgs_mi.render.blocks import BlockLists, build_lists, fetch_record
from morgs_mi.render.projection import project
from morgs_mi.render.region import full_view

# Labels of the traced loops.
LOOPS = {"blend": "blend", "adjoint": "blend (adjoint)"}


@dataclass(frozen=True)
class Options:
    """Workloads and output."""

    workload: tuple[Path, ...]
    """Workload files, .npz."""
    json: Path | None = None
    """JSON file for the figures; default is standard output."""
    repeats: int = 15
    """Number of timed steps; medians are reported."""


def take_step(gaussians: Gaussians, camera: Camera) -> None:
    """Take one step: colour, forward and backward."""
    timing.stages(gaussians, camera)["step"]()
    dr.sync_thread()


def print_listing(workload: str) -> None:
    """Take one step with a log level that prints every kernel; to be run in a separate process."""
    mi.set_variant("llvm_ad_rgb")
    dr.set_log_level(dr.LogLevel.Trace)
    take_step(*workloads.load(Path(workload)))


def listing(workload: Path) -> str:
    """Return Dr.Jit's log of one step on a workload: kernels in IR and machine code."""
    code = "import sys; from benchmarks.speed.count_instructions import print_listing; print_listing(sys.argv[1])"
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"DRJIT_CACHE_DIR": folder}
        command = [sys.executable, "-c", code, str(workload.resolve())]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=Path(__file__).parents[2])
    if done.returncode:
        raise SystemExit(f"count_instructions.py: the listed step failed:\n{done.stderr[-2000:]}")
    return done.stdout + done.stderr


# --------------------------------------------------------------------------------------------------
#  Iterations and speed
# --------------------------------------------------------------------------------------------------


def walk_counts(lists: BlockLists, blocks: loops.Blocks, layout: loops.Layout) -> tuple[Any, Any]:
    """Return per lane, in the order of the packets, the entries walked before the stop and the pixels they affect."""
    # The functions of the traced loops, so that the stop is the same.
    block = loops._Block(layout, blocks)

    def body(walk, end, x, y, T, walked, reached, records, words, entries):
        rank, walk = loops._advance(walk, end, words, entries)
        geometry, T_next, hits = fetch_record(records, rank, layout.geometry, packets), [], mi.UInt32(0)
        for light, (p, _) in zip(T, block.powers(*block.offsets(x, y, geometry), geometry), strict=True):
            alpha = block.alpha(p)[0]
            T_next.append(light - alpha * light)
            hits += dr.select(alpha > 0, mi.UInt32(1), mi.UInt32(0))
        return walk, end, x, y, T_next, walked + 1, reached + hits, records, words, entries

    packets = loops.record_packets(layout)
    light, zero = [mi.Float(1)] * block.area, mi.UInt32(0)
    state = (block.walk, block.end, block.x, block.y, light, zero, zero, lists.records, blocks.words, blocks.entries)
    *_, walked, reached, _, _, _ = dr.while_loop(
        state, lambda walk, end, x, y, T, *_: block.continues(walk, T), body, label="count"
    )
    return walked, reached


def work(gaussians: Gaussians, camera: Camera, lanes: int) -> dict[str, Any]:
    """Return the iterations of the loops and their utilisation."""
    config = RenderConfig()
    layout = loops.Layout((loops.Channel(3, True),), False, False, config)
    with dr.suspend_grad():
        region = full_view(camera.width, camera.height, config)
        splats = project(gaussians, camera, ("color",), config)
        lists = build_lists(splats, list(splats.channels["color"]), region, config)
        walked, reached = walk_counts(lists, loops.Blocks.of(region, lists), layout)
        walked, reached, listed = (np.asarray(v, np.int64) for v in (walked, reached, lists.count))
    turns = int(np.pad(walked, (0, -len(walked) % lanes)).reshape(-1, lanes).max(1).sum())
    pairs, area = int(walked.sum()), region.block[0] * region.block[1]
    return {
        "pairs_listed": int(listed.sum()),
        "pairs_walked": pairs,
        "turns": turns,
        "lanes_busy": round(pairs / (lanes * turns), 3),
        "pixels_reached": round(int(reached.sum()) / (pairs * area), 3),
        "pixels_per_block": area,
    }


def stage_times(gaussians: Gaussians, camera: Camera, repeats: int) -> dict[str, float]:
    """Return the median ms of a step's stages: kernels up to the blend, the blend, the loss, the adjoint, the rest."""
    step, rows = timing.stages(gaussians, camera)["step"], []
    for k in range(repeats + 2):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.sync_thread()
            start = time.perf_counter()
            step()
            dr.sync_thread()
            total = 1e3 * (time.perf_counter() - start)
            history = dr.kernel_history()
        row, stage = defaultdict[str, float](float), "projection and lists"
        for entry in history:
            ir = entry.get("ir") or ""
            ir = ir if isinstance(ir, str) else ir.getvalue()
            found = next((name for name, label in LOOPS.items() if f"; Symbolic loop: {label}\n" in ir), None)
            row[found or stage] += entry["execution_time"]
            stage = {"blend": "loss", "adjoint": "projection's adjoint"}.get(found or "", stage)
        row["outside kernels"] = total - sum(row.values())
        row["step"] = total
        if k >= 2:
            rows.append(row)
    return {name: round(median(row[name] for row in rows), 3) for name in rows[0]}


def clock_ghz() -> float:
    """Return the clock in GHz, measured by a chain of integer additions and exclusive-ors of one cycle each."""
    a, b = dr.opaque(mi.UInt32, 0x9E3779B9), dr.opaque(mi.UInt32, 0x85EBCA6B)

    def chain(turns: int) -> float:
        def body(k, x, a, b):
            for _ in range(64):
                x = (x + a) ^ b
            return k + 1, x, a, b

        n = dr.opaque(mi.UInt32, turns)
        start = time.perf_counter()
        x = dr.while_loop((mi.UInt32(0), mi.UInt32(1), a, b), lambda k, *_: k < n, body, label="clock")[1]
        dr.eval(x)
        dr.sync_thread()
        return time.perf_counter() - start

    chain(1000)
    short, long = (min(chain(turns) for _ in range(7)) for turns in (20_000, 220_000))
    return round(200_000 * 128 / (long - short) * 1e-9, 2)


def report(path: Path, repeats: int) -> dict[str, Any]:
    """Return the figures of one workload."""
    gaussians, camera = workloads.load(path)
    log = listing(path)
    found = re.search(r"<(\d+) x float>", log)
    lanes = int(found[1]) if found else 1
    result: dict[str, Any] = {"workload": path.name, "gaussians": len(gaussians)}
    result |= {"size": [camera.width, camera.height], "lanes": lanes} | work(gaussians, camera, lanes)
    result["clock_ghz"] = clock_ghz()
    result["milliseconds"] = stage_times(gaussians, camera, repeats)
    for name, label in LOOPS.items():
        body, inner = main_loop(kernel_code(log, label))
        figures = counts(body)
        busy = 1e6 * result["milliseconds"][name] * dr.thread_count() * result["clock_ghz"] / result["turns"]
        figures["per_packet_of_pixels"] = round(figures["total"] / result["pixels_per_block"], 1)
        figures["cycles_per_turn"] = round(busy)
        figures["instructions_per_cycle"] = round(figures["total"] / busy, 2)
        result[name] = figures | {"next_word": len(inner)}
    return result


def main(options: Options) -> None:
    """Run the benchmark."""
    if platform.machine() not in ("x86_64", "AMD64"):
        raise SystemExit(f"count_instructions.py: expected an x86-64 processor, got {platform.machine()}.")
    mi.set_variant("llvm_ad_rgb")
    results = [report(path, options.repeats) for path in options.workload]
    text = json.dumps(
        {"workloads": results, "threads": dr.thread_count(), "machine": machine(), "versions": versions()}, indent=2
    )
    if options.json:
        options.json.write_text(text + "\n")
    else:
        print(text)


if __name__ == "__main__":
    main(tyro.cli(Options))
