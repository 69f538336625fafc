"""Count what the host does for a later frame, by stage, and for a step of the first frame.

    python -m benchmarks.speed.host --json benchmarks/results/host.json \
        --plot docs/experiments/host.png

`floor` is a frame whose arithmetic costs nothing, so that the host remains; `small` and `n3dv` are
the scenes of `frame_speed`. A frame is counted after five others, when all kernels and recordings
are there. *Operations* are all entries of Dr.Jit's history: kernels, memsets, sorts, sums, copies.
*Reads* are numbers that reach Python or NumPy, *uploads* arrays that come from NumPy, both with
their bytes; *stops* are what waits for the queue: the reads, and selections of lanes. The seconds
in Python are those that neither a kernel nor the compiler takes: tracing, launches, NumPy and
OpenCV. Two fits of the first frame, with few and with many steps, are counted; a step of it is the
difference of their counts, divided by the difference of their numbers of steps.

Counts are the same on every run; seconds depend on what else the machine does.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

import morgs_mi.stream_loop
from benchmarks.reports.plots import blank_figure, markdown, save_figure
from benchmarks.speed import frame_speed
from benchmarks.speed.frame_speed import Scene, Size, default_config, loop_of
from benchmarks.speed.output import Output
from morgs_mi import FitConfig, StreamConfig, fit_gaussians
from morgs_mi.core import arrays
from morgs_mi.fit import later_frame
from morgs_mi.loop import observation
from morgs_mi.method import motion
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.render.kernel_recording import num_recordings

STAGES: tuple[tuple[str, Any, str], ...] = (
    ("images", observation, "copied_images"),
    ("exposures, changes", observation, "_seen_views"),
    ("flow, masks", observation, "_key_views"),
    ("active set", morgs_mi.stream_loop, "find_active_set"),
    ("active set", ActiveSet, "with_static"),
    ("lift", motion.STARTS, "lift_flow"),
    ("propagation", motion.STARTS, "propagate_motion"),
    ("search", motion.STARTS, "search_motion"),
    ("refinement", motion.STARTS, "refine_start"),
    ("confidence", motion, "share_confidence"),
    ("residual", morgs_mi.stream_loop, "fit_later_frame"),
    ("steps", later_frame, "optimise"),
    ("packet", morgs_mi.stream_loop, "residual_packet"),
    ("decoding", morgs_mi.stream_loop, "decode"),
)
"""Name of a stage, and the module or table whose entry is the stage's function."""

FLOOR = Size(96, 72, 20, 3_000, 2)
"""A size without arithmetic."""
FIRST_STEP = "first frame, a step"
"""Row of the first frame beside the stages."""

# Frames before the one that is counted.
_WARM_UP = 5
# Steps of the two first frames that are compared.
_FEW_STEPS = 40
MANY_STEPS = 200
_MS = 1e-3


@dataclass(frozen=True)
class Options(Output):
    """Scenes and output."""

    sizes: tuple[str, ...] = ("floor", "small", "n3dv")
    """Sizes to count, among floor, small and n3dv."""
    epochs: int = 2
    """Epochs of a later frame."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant."""
    plot: Path | None = None
    """File for a plot of the operations and seconds by stage."""


def clocks() -> dict[str, float]:
    """Return the wall and processor seconds so far."""
    return {"seconds": time.perf_counter(), "processor": time.process_time()}


class Profile:
    """What grows in each stage of a later frame while it is entered; `other` is outside of all
    stages, and a stage has what grows outside of the stages inside it.

    Work is synchronised wherever a stage begins or ends, so a total may be longer than the time of
    a frame that is not profiled.

    Args:
        read: returns numbers by name, which never fall.
    """

    def __init__(self, read: Callable[[], Mapping[str, float]]) -> None:
        self.totals: dict[str, Any] = {}
        self._open = ["other"]
        self._patches = ExitStack()
        self._read = read
        self._last: Mapping[str, float] = {}

    def __enter__(self) -> Profile:
        for name, place, attribute in STAGES:
            if isinstance(place, Mapping):
                stage = self._timed(name, place[attribute])
                self._patches.enter_context(patch.dict(place, {attribute: stage}))
            else:
                stage = self._timed(name, getattr(place, attribute))
                self._patches.enter_context(patch.object(place, attribute, stage))
        # One stage after the other.
        self._patches.enter_context(patch.object(observation, "in_background", _at_once))
        dr.sync_thread()
        self._last = self._read()
        return self

    def __exit__(self, *error: object) -> None:
        self._border()
        self._patches.close()

    def _border(self) -> None:
        """Add what has grown since the last border to the innermost open stage."""
        dr.sync_thread()
        numbers = self._read()
        total = self.totals.setdefault(self._open[-1], Counter())
        total.update({name: value - self._last.get(name, 0) for name, value in numbers.items()})
        self._last = numbers

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def stage(*args: Any, **kwargs: Any) -> Any:
            self._border()
            self._open.append(name)
            try:
                return function(*args, **kwargs)
            finally:
                self._border()
                self._open.pop()

        return stage


def _at_once(function: Callable[[], Any]) -> Future[Any]:
    """Return the result of a function, as `in_background` does."""
    future: Future[Any] = Future()
    future.set_result(function())
    return future


class HostCounts:
    """Operations, recordings, reads, uploads, stops and seconds since it was entered.

    For a process of its own: Python cannot put back the operators of Dr.Jit's arrays that it
    replaces.
    """

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._patches = ExitStack()

    def __enter__(self) -> HostCounts:
        flag = dr.scoped_set_flag(dr.JitFlag.KernelHistory, True)
        self._patches.enter_context(flag)
        dr.kernel_history_clear()
        for kind in (mi.Float, mi.Float64, mi.UInt32, mi.Int32, mi.Bool):
            self._count(kind, "__getitem__", self._read_element)
        for name in ("__array__", "__bool__"):
            self._count(dr.ArrayBase, name, self._read_all)
        self._count(dr, "compress", lambda *_: self._counts.update(stops=1))
        # Modules have imported the function by its name.
        original = arrays.from_numpy
        for name, module in list(sys.modules.items()):
            if name.startswith("morgs_mi") and vars(module).get("from_numpy") is original:
                self._count(module, "from_numpy", self._upload)
        return self

    def __exit__(self, *error: object) -> None:
        self._patches.close()

    def _count(self, place: Any, name: str, note: Callable[..., None]) -> None:
        """Call `note` with the arguments of a function before each of its calls."""
        function = getattr(place, name)

        def counted(*args: Any, **kwargs: Any) -> Any:
            note(*args)
            return function(*args, **kwargs)

        self._patches.enter_context(patch.object(place, name, counted))

    def _read_element(self, array: Any, *_: Any) -> None:
        self._read(dr.type_v(type(array)), 1)

    def _read_all(self, array: Any, *_: Any) -> None:
        self._read(dr.type_v(type(array)), dr.width(array))

    def _read(self, kind: dr.VarType, count: int) -> None:
        self._counts.update(reads=1, stops=1, read_bytes=count * _item_size(kind))

    def _upload(self, kind: Any, values: Any) -> None:
        num_bytes = np.size(values) * _item_size(dr.type_v(kind))
        self._counts.update(uploads=1, upload_bytes=num_bytes)

    def read(self) -> Mapping[str, float]:
        """Return all counts so far, by name: a type of operation has the name ``type NAME``."""
        for entry in dr.kernel_history():
            kind = str(entry["type"]).rpartition(".")[-1]
            self._counts.update({f"type {kind}": 1, "operations": 1})
            self._counts["kernel seconds"] += _MS * entry["execution_time"]
            compiling = entry.get("codegen_time", 0) + entry.get("backend_time", 0)
            self._counts["compiler seconds"] += _MS * compiling
        return {**self._counts, **clocks(), "recordings": num_recordings()}


def _item_size(kind: dr.VarType) -> int:
    """Return the bytes of a number."""
    return np.dtype(kind.name.lower()).itemsize


def figures(totals: Mapping[str, float]) -> dict[str, Any]:
    """Return the counts and seconds of a stage as they are written."""
    types = {name[5:]: round(n, 1) for name, n in totals.items() if name.startswith("type ") and n}
    counts = ("operations", "recordings", "reads", "read_bytes", "uploads", "upload_bytes", "stops")
    seconds = {
        "kernels": totals.get("kernel seconds", 0),
        "compiler": totals.get("compiler seconds", 0),
        "wall": totals["seconds"],
        "processor": totals["processor"],
    }
    seconds["python"] = seconds["wall"] - seconds["kernels"] - seconds["compiler"]
    return {
        **{name: round(totals.get(name, 0), 1) for name in counts},
        "types": types,
        "seconds": {name: float(f"{value:.3g}") for name, value in seconds.items()},
    }


def count_frame(size: Size, epochs: int) -> dict[str, Any]:
    """Return the figures of a later frame, by stage and in total."""
    scene = Scene(size, 0)
    recorded = scene.recorded(_WARM_UP + 2, 0)
    loop = loop_of(scene, default_config(size, epochs), recorded[0])
    for images in recorded[1:-1]:
        # Recordings depend on the flag of Dr.Jit's history.
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            loop.push(images[1:])
    with HostCounts() as counts, Profile(counts.read) as profile:
        loop.push(recorded[-1][1:])
    total: Counter[str] = Counter()
    for stage in profile.totals.values():
        total.update(stage)
    stages = {**profile.totals, "total": total}
    return {name: figures(stage) for name, stage in stages.items()}


def count_first_step(size: Size) -> dict[str, Any]:
    """Return the figures of a step of the first frame, without density control."""
    scene = Scene(size, 0)
    images = scene.recorded(1, 0)[0][1:]
    cameras = scene.cameras()[1:]
    points = np.asarray(scene.at(0).means)
    colors = np.full(points.shape, 0.5)

    def fit(steps: int) -> Mapping[str, float]:
        config = FitConfig(
            sh_degree=0, num_gaussians=size.gaussians, first_frame_steps=steps, exposure="off"
        )
        with HostCounts() as counts:
            start = counts.read()
            fit_gaussians(cameras, images, points, colors, StreamConfig(config))
            dr.sync_thread()
            end = counts.read()
        return {name: value - start.get(name, 0) for name, value in end.items()}

    for steps in (_FEW_STEPS, MANY_STEPS):  # what one of them compiles, the other may not need
        fit(steps)
    few = fit(_FEW_STEPS)
    many = fit(MANY_STEPS)
    steps = MANY_STEPS - _FEW_STEPS
    return figures({name: (value - few.get(name, 0)) / steps for name, value in many.items()})


def table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures of one size as a table, a stage per row."""
    heads = ("operations", "kernels", "memsets", "reads", "uploads", "stops", "wall, ms", "kernels")
    lines = []
    for name in (*dict.fromkeys(name for name, *_ in STAGES), "other", "total", FIRST_STEP):
        row = rows.get(name)
        if row is not None:
            types = [row["types"].get(kind, 0) for kind in ("JIT", "Memset")]
            seconds = row["seconds"]
            share = seconds["kernels"] / seconds["wall"]
            numbers = [row["operations"], *types, row["reads"], row["uploads"], row["stops"]]
            cells = [f"{number:.0f}" for number in numbers]
            lines.append((name, *cells, f"{1e3 * seconds['wall']:.1f}", f"{100 * share:.0f} %"))
    return markdown(("stage", *heads), lines)


def sizes_table(sizes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the operations of each stage that has some, a size per column, and what the host
    exchanges.
    """
    stages = [*dict.fromkeys(name for name, *_ in STAGES), "other", "total"]
    lines = [
        (
            name,
            *(
                f"{rows[name]['operations']:.0f}" if name in rows else "-"
                for rows in sizes.values()
            ),
        )
        for name in stages
        if any(rows.get(name, {}).get("operations") for rows in sizes.values())
    ]
    for count in ("recordings", "reads", "uploads", "stops"):
        lines.append((count, *(f"{rows['total'][count]:.0f}" for rows in sizes.values())))
    lines.append(
        (FIRST_STEP, *(f"{rows[FIRST_STEP]['operations']:.0f}" for rows in sizes.values()))
    )
    return markdown(("", *sizes), lines)


def plot(sizes: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return the operations and the seconds of each stage, a column of plots per size."""
    image = blank_figure(4 * len(sizes), 5)
    axes = image.subplots(2, len(sizes), squeeze=False)
    for (name, rows), (counts, times) in zip(sizes.items(), axes.T, strict=True):
        names = [stage for stage in rows if stage not in ("total", FIRST_STEP)][::-1]
        counts.barh(names, [rows[stage]["operations"] for stage in names])
        counts.set(title=name, xlabel="operations")
        left = np.zeros(len(names))
        for part in ("kernels", "compiler", "python"):
            widths = np.array([max(rows[stage]["seconds"][part], 0) for stage in names])
            times.barh(names, widths, left=left, label=part)
            left += widths
        times.set(xlabel="seconds")
    axes[1, -1].legend(fontsize=8)
    return image


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant(options.variant)
    result: dict[str, Any] = {}
    for name in options.sizes:
        size = {"floor": FLOOR, **frame_speed.SIZES}[name]
        result[name] = {**count_frame(size, options.epochs), FIRST_STEP: count_first_step(size)}
        print(name, table(result[name]), sep="\n", flush=True)
    if options.plot is not None:
        save_figure(plot(result), options.plot)
    header = {"variant": options.variant, "epochs": options.epochs}
    options.write({**header, "sizes": result}, unprinted=("sizes",))


if __name__ == "__main__":
    main(tyro.cli(Options))
