"""Compare the run times of this checkout and of another commit, which run in turn.

    python -m benchmarks.speed.pairs BASE --recordings SETS --json benchmarks/results/pairs.json

BASE is a checkout of the commit to compare with. The two runs of a pair are a process each, which
take turns. `floor`, `small` and `n3dv` are the later frames that `benchmarks.speed.host` counts.
`first` is a step of the first frame and `splat` one of a user's loop with `rasterize` and
`dr.backward`: with 3,000 Gaussians at 96x72 (`floor`), 20,000 at 512x384 (`mid`) and 300 at 32x24
(`tiny`). The other cases fit recordings. *Memory* is the largest of a process, in MB.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

# Only what both checkouts have: this file runs with the package of either.
import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

import morgs_mi
from benchmarks.reports.plots import markdown
from benchmarks.speed import frame_speed
from benchmarks.speed.output import Output

_SIZES = {
    "tiny": frame_speed.Size(32, 24, 8, 300, 2),
    "floor": frame_speed.Size(96, 72, 20, 3_000, 2),
    "mid": frame_speed.Size(512, 384, 8, 20_000, 2),
    **frame_speed.SIZES,
}
_LATER_FRAMES = 6
_FEW_STEPS = 100
_MANY_STEPS = 500
# Turns of a user's loop, whose steps take up to 1.5 times as long in one minute as in the next.
_TURNS = 40
_TURN_STEPS = 50
# Recordings and the numbers of frames that are fitted.
_RECORDINGS = {"demo": 2, "basketball": 8}


@dataclass(frozen=True)
class Options(Output):
    """Checkouts and cases."""

    base: tyro.conf.Positional[Path] = Path()
    """Checkout of the commit to compare with."""
    cases: tuple[str, ...] = (
        *("later floor", "later small", "later n3dv", "first tiny", "first floor", "first mid"),
        *("splat floor", "splat mid", "fit demo", "fit basketball"),
    )
    """Cases to run: what is measured, and the size or recording."""
    pairs: int = 5
    """Pairs of each case."""
    recordings: Path = Path("recordings")
    """Folder of the recordings demo and basketball."""


def _later(name: str) -> Iterator[dict[str, float]]:
    """Yield the seconds of a later frame."""
    size = _SIZES[name]
    scene = frame_speed.Scene(size, 0)
    images = scene.recorded(_LATER_FRAMES + 1, 0)
    loop = frame_speed.loop_of(scene, frame_speed.default_config(size, 2), images[0])
    seconds = [_seconds(partial(loop.push, views[1:])) for views in images[1:]]
    yield {f"{name}, a later frame": median(seconds[2:])}


def _first(name: str) -> Iterator[dict[str, float]]:
    """Yield the seconds of a step of the first frame."""
    size = _SIZES[name]
    scene = frame_speed.Scene(size, 0)
    cameras = scene.cameras()[1:9]
    images = scene.recorded(1, 0)[0][1:9]
    points = np.asarray(scene.at(0).means)[::3]

    def fit(steps: int) -> None:
        settings = morgs_mi.FitConfig(
            sh_degree=0, num_gaussians=size.gaussians, first_frame_steps=steps, exposure="off"
        )
        config = morgs_mi.StreamConfig(fit=settings)
        morgs_mi.fit_gaussians(cameras, images, points, np.full(points.shape, 0.5), config)

    yield {f"{name}, a step of the first frame": _per_step(fit)}


def _splat(name: str) -> Iterator[dict[str, float]]:
    """Yield the seconds of a step of a user's loop over the cameras in each turn."""
    scene = frame_speed.Scene(_SIZES[name], 0)
    cameras = scene.cameras()[1:9]
    images = scene.recorded(1, 0)[0][1:9]
    targets = [_target(image) for image in images]
    start = scene.gaussians(np.asarray(scene.at(0).means), 0.02)
    optimizer = mi.ad.Adam(lr=1e-3, params=start.parameters())

    def fit() -> None:
        for step in range(_TURN_STEPS):
            gaussians = morgs_mi.Gaussians.from_parameters(optimizer)
            color = morgs_mi.rasterize(gaussians, cameras[step % 8], ("color",)).color
            dr.backward(dr.mean(dr.abs(color - targets[step % 8]), axis=None))
            optimizer.step()

    for _ in range(2):  # compiles kernels
        fit()
    for _ in range(_TURNS):
        yield {f"{name}, a step of a user's loop": _seconds(fit) / _TURN_STEPS}


def _target(image: Any) -> Any:
    return mi.TensorXf(image.astype(np.float32) / 255)


def _fit(recording: str) -> Iterator[dict[str, float]]:
    """Yield the seconds of the first and of the later frames of a recording."""
    frames = _RECORDINGS[Path(recording).name]
    with tempfile.TemporaryDirectory() as folder:
        command = ["morgs_mi", "fit", recording, folder + "/fit", "--frames", str(frames)]
        subprocess.run([sys.executable, "-m", *command], check=True, stdout=subprocess.DEVNULL)
        report = json.loads(Path(folder, "fit", "report.json").read_text())
    first, *later = (frame["seconds"] for frame in report["frames"])
    name = Path(recording).name
    yield {f"{name}, first frame": first, f"{name}, later frames": sum(later)}


def _seconds(work: Callable[[], Any]) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    work()
    dr.sync_thread()
    return time.perf_counter() - start


def _per_step(fit: Callable[[int], None]) -> float:
    """Return the seconds of a step, from fits of few and of many steps."""
    fit(_FEW_STEPS)
    few_seconds = _seconds(partial(fit, _FEW_STEPS))
    many_seconds = _seconds(partial(fit, _MANY_STEPS))
    return (many_seconds - few_seconds) / (_MANY_STEPS - _FEW_STEPS)


_MEASURES = {"later": _later, "first": _first, "splat": _splat, "fit": _fit}


def _measure(measure: str, argument: str) -> None:
    """Print seconds and the largest memory of this process and its children in MB by name, in a
    turn for each line of the standard input.
    """
    mi.set_variant("llvm_ad_rgb")
    turns = _MEASURES[measure](argument)
    for _ in sys.stdin:
        seconds = next(turns, {})
        users = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        memory = max(resource.getrusage(user).ru_maxrss for user in users) / 1024
        print(json.dumps({name: [value, memory] for name, value in seconds.items()}), flush=True)


def _pair(checkouts: Sequence[Path], case: str, recordings: Path) -> dict[str, np.ndarray]:
    """Return median seconds and MB [C, 2] of a case, by name, with the package of C checkouts in
    turn.
    """
    measure, name = case.split()
    argument = str(recordings / name) if measure == "fit" else name
    command = [sys.executable, __file__, "--measure", measure, argument]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [
        subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(checkout)}, **pipes)
        for checkout in checkouts
    ]
    turns: list[list[dict[str, Any]]] = []
    while not turns or turns[-1][0]:
        turns.append([_turn(process) for process in processes])
    for process in processes:
        process.communicate()
    return {
        name: np.median([[figures[name] for figures in turn] for turn in turns[:-1]], 0)
        for name in turns[0][0]
    }


def _turn(process: subprocess.Popen[str]) -> dict[str, list[float]]:
    """Return what a process measures in its next turn; nothing after the last."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def pair_row(figures: np.ndarray) -> dict[str, Any]:
    """Return the ratios of P pairs, and the medians of both checkouts.

    Args:
        figures: seconds and MB [P, 2, 2], by pair, checkout (the base first) and figure.
    """
    ratios = figures[:, 1, 0] / figures[:, 0, 0]
    seconds, memory = np.median(figures, 0).T
    return {
        "ratio": round(float(np.median(ratios)), 3),
        "ratios": np.round(ratios, 3).tolist(),
        "seconds": np.round(seconds, 5).tolist(),
        "memory": np.round(memory).tolist(),
    }


def pairs_table(rows: Mapping[str, Any]) -> str:
    """Return the ratios of the pairs, and the medians of seconds and memory."""
    lines = []
    for name, row in rows.items():
        ratios = sorted(row["ratios"])
        medians = [f"{value:.2g}" for value in row["seconds"]]
        memory = [f"{value:.0f}" for value in row["memory"]]
        lines.append(
            (name, f"{row['ratio']:.2f}", f"{ratios[0]:.2f} to {ratios[-1]:.2f}", *medians, *memory)
        )
    titles = "ratio", "of the pairs", "s before", "s now", "MB before", "MB now"
    return markdown(("", *titles), lines)


def main(options: Options) -> None:
    """Run the pairs."""
    trees = (options.base, Path(__file__).parents[2])
    rows: dict[str, Any] = {}
    for case in options.cases:
        pairs = [_pair(trees, case, options.recordings) for _ in range(options.pairs)]
        for name in pairs[0]:
            rows[name] = pair_row(np.array([pair[name] for pair in pairs]))
            print(f"{name:36s}", rows[name], flush=True)
    command = ["git", "-C", str(options.base), "rev-parse", "--short", "HEAD"]
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    options.write({"base": process.stdout.strip(), "pairs": rows}, unprinted=("pairs",))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        _measure(*sys.argv[2:])
    else:
        main(tyro.cli(Options))
