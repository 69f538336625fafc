"""Profile the stages of later frames: seconds, views that are drawn, and the serial share.

    python -m benchmarks.speed.stages --fit out/basketball --json out.json

`small` and `n3dv` are the scenes of `frame_speed`, frame 3; of a fit of basketball, frames 1 and 7
are fitted again. All arrive live. Work is synchronised wherever a stage begins or ends, so a total
may be longer than the time of a frame that is not profiled. A stage has the seconds that it spends
outside of the stages inside it; *passes* counts views that are drawn, differentiated or
back-projected. With n cores and the processor time C, the serial share of a stage is
(n - C / seconds) / (n - 1).
"""

from __future__ import annotations

import os
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
import tyro

import morgs_mi.stream_loop
from benchmarks.reports.plots import markdown
from benchmarks.speed import frame_speed
from benchmarks.speed.frame_speed import Scene, default_config, loop_of
from benchmarks.speed.output import Output
from morgs_mi import open_stream
from morgs_mi.codec.packets import coded_frames
from morgs_mi.fit import later_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.frozen_step import RecordedSteps
from morgs_mi.loop import observation
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method import motion
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.playback.stream_header import open_stream_capture
from morgs_mi.render.active_view import Drawing, ViewGroup
from morgs_mi.runs.fit_files import FitFiles, read_reports
from morgs_mi.stream_loop import StreamLoop

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


@dataclass(frozen=True)
class Options(Output):
    """Scenes and output."""

    sizes: tuple[str, ...] = ("small", "n3dv")
    """Sizes of `frame_speed` that are profiled."""
    fit: Path | None = None
    """Folder of a fit of eight frames or more; none: it is left out."""
    epochs: int = 2
    """Epochs of a later frame."""


def clocks() -> dict[str, float]:
    """Return the wall and processor seconds so far."""
    return {"seconds": time.perf_counter(), "processor": time.process_time()}


class Profile:
    """What grows in each stage while it is entered, and its passes; `other` is outside of all
    stages.

    Args:
        read: returns numbers by name, which never fall.
    """

    def __init__(self, read: Callable[[], Mapping[str, float]] = clocks) -> None:
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
        views = {
            (ViewGroup, "draw"): lambda group: len(group.views),
            (Drawing, "_sums"): lambda drawing: len(drawing.group.views),
            (later_frame, "render_view"): lambda gaussians: 1,
            # Recordings are counted where they are replayed.
            (dr, "backward"): lambda loss: not dr.flag(dr.JitFlag.FreezingScope),
            (RecordedSteps, "step"): lambda steps: 2,
        }
        for (place, attribute), count in views.items():
            function = self._counted(getattr(place, attribute), count)
            self._patches.enter_context(patch.object(place, attribute, function))
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

    def _counted(
        self, function: Callable[..., Any], count: Callable[[Any], int]
    ) -> Callable[..., Any]:
        def counted(subject: Any, *args: Any, **kwargs: Any) -> Any:
            self.totals.setdefault(self._open[-1], Counter()).update(passes=count(subject))
            return function(subject, *args, **kwargs)

        return counted

    def rows(self) -> dict[str, dict[str, float]]:
        """Return seconds, passes and the serial share, by stage and in total."""
        total: Any = Counter()
        for stage in self.totals.values():
            total.update(stage)
        cores = len(os.sched_getaffinity(0))
        rows = {}
        for name, stage in {**self.totals, "total": total}.items():
            serial = (cores - stage["processor"] / stage["seconds"]) / max(cores - 1, 1)
            rows[name] = {
                "seconds": float(f"{stage['seconds']:.3g}"),
                "passes": int(stage["passes"]),
                "serial": float(f"{min(max(serial, 0), 1):.2f}"),
            }
        return rows


def _at_once(function: Callable[[], Any]) -> Future[Any]:
    """Return the result of a function, as `in_background` does."""
    future: Future[Any] = Future()
    future.set_result(function())
    return future


def profile_scene(size: str, epochs: int) -> dict[str, dict[str, float]]:
    """Return the profile of frame 3 of a scene of `frame_speed`."""
    scene = Scene(frame_speed.SIZES[size], 0)
    recorded = scene.recorded(4, 0)
    loop = loop_of(scene, default_config(scene.size, epochs), recorded[0])
    for images in recorded[1:3]:
        loop.push(images[1:])
    with Profile() as profile:
        loop.push(recorded[3][1:])
    return profile.rows()


def profile_fit(out: Path, frame: int, epochs: int) -> dict[str, dict[str, float]]:
    """Return the profile of a frame that is fitted after the packets of a fit, for the third time,
    so that all kernels are there.
    """
    stream = open_stream(out)
    capture = open_stream_capture(stream, None, stream.frame_numbers())
    (first,) = read_reports(FitFiles.of(out).report, range(1))
    states = {state.frame: state for state in coded_frames(iter(stream))}
    recorded = [f.comparable for f in capture.partial_frames(0, frame + 1)]
    loop = StreamLoop.of(capture, StreamConfig(FitConfig(epochs=epochs)))
    profile = Profile()
    for _ in range(3):
        profile = Profile()
        loop.resume(states[frame - 1], recorded[:frame], first.exposures)
        with profile:
            loop.push(recorded[frame])
    return profile.rows()


def table(profiles: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Return the seconds of the profiles as a table, a stage per row, in the order of the frame."""
    names = [*dict.fromkeys(name for name, *_ in STAGES), "other", "total"]
    rows = [
        (name, *(f"{p[name]['seconds']:.2f}" if name in p else "-" for p in profiles.values()))
        for name in names
    ]
    return markdown(("stage", *profiles), rows)


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant("llvm_ad_rgb")
    profiles: dict[str, Any] = {
        f"{size}, frame 3": profile_scene(size, options.epochs) for size in options.sizes
    }
    if options.fit is not None:
        for frame in (1, 7):
            profile = profile_fit(options.fit, frame, options.epochs)
            profiles[f"basketball, frame {frame}"] = profile
    print(table(profiles))
    options.write({"epochs": options.epochs, "profiles": profiles}, unprinted=("profiles",))


if __name__ == "__main__":
    main(tyro.cli(Options))
