"""The fits of a sweep, seed by seed and arm by arm, each of which is made once."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.outputs import check_output
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.results import ViewScores
from morgs_mi.extras.sweep.clock import Clock, load_average, moment, stopwatch
from morgs_mi.extras.sweep.statistics import SCORES
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.objective import ObjectiveConfig
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.config import apply_values
from morgs_mi.platform.files import locked_folder, write_json
from morgs_mi.platform.progress import Progress, Report, name_of
from morgs_mi.runs.fit_capture import (
    begin_as,
    push_frame,
    stream_capture,
    with_border,
    with_points,
)
from morgs_mi.runs.fit_files import stream_metadata
from morgs_mi.stream_loop import StreamLoop

# The first frame and two later ones, with masks, compile the kernels of an arm.
_WARM_FRAMES = 3
_WARM = {"fit": {"first_frame_steps": 60, "epochs": 2}, "motion": {"mask_interval": 1}}
# Digits of the digest in the name of a first frame's folder.
_DIGEST = 8
_NO_CLOCK = Clock()
# Begin and end of the stages of a fit that take long, as shares of it.
_SPANS = {"First frame": (0.0, 0.5), "Later frames": (0.5, 1.0)}


@dataclass(frozen=True)
class Arm:
    """The method with some settings, under a name."""

    name: str  #: Of the settings; a curve has the arms of one name.
    config: StreamConfig  #: The settings.
    point: int  #: What is varied along a curve: epochs, or steps of the first frame.
    first_alone: bool = False  #: Whether the first frame alone is fitted and scored.


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of A arms with S seeds, as far as they are made."""

    scores: np.ndarray  #: [A, S, N] in the order of `SCORES`; NaN where unknown or not made.
    calls: np.ndarray  #: [A, S], equal where fits ran in turn; empty where not made.
    clocks: list[Clock] = field(default_factory=list)  #: Of the fits, in the order of the seeds.

    @classmethod
    def of(cls, arms: int, seeds: int) -> Fits:
        """Return the fits of some arms and seeds before any is made."""
        return cls(np.full((arms, seeds, len(SCORES)), np.nan), np.full((arms, seeds), "", object))

    def __add__(self, other: Fits) -> Fits:
        """Return these fits and those of further arms."""
        return Fits(
            np.concatenate([self.scores, other.scores]),
            np.concatenate([self.calls, other.calls]),
            self.clocks + other.clocks,
        )


@dataclass(frozen=True)
class StoredFit:
    """A fit that was made, as its folder has it."""

    made: Any = None  #: What it was made of: settings, images, the first frame that it continues.
    clock: Clock = _NO_CLOCK  #: When and how fast it ran.
    network: str | None = None  #: Network of LPIPS of its evaluation; empty: none.
    scores: Sequence[float | None] = ()  #: Of `SCORES`, means over its frames.


def fit_arms(
    arms: Sequence[Arm],
    capture: Capture,
    seeds: int,
    out: Path,
    measure: str,
    progress: Progress,
    on_fit: Callable[[Fits], Any],
) -> Fits:
    """Return the fits of some arms, made where they are missing.

    They are made seed by seed, so that a change of the machine's load reaches all arms, and in the
    order of the arms.

    Args:
        arms: the arms.
        capture: what is fitted.
        seeds: number of seeds 0, 1, ....
        out: folder of all fits.
        measure: as of `Vary`.
        progress: of all of them.
        on_fit: called with the fits so far after each that was made, and at the end, also that of
            an interruption.

    Raises:
        ValueError: as `stream_capture`, or the network is missing or another one.
        OSError: as `stream_capture`.
    """
    check_output(out)
    folder = _FitsFolder(capture, out, measure)
    fits = Fits.of(len(arms), seeds)
    total = seeds * len(arms)
    with locked_folder(out, "sweep()"), ExitStack() as at_end:
        at_end.callback(on_fit, fits)
        for done, (seed, k) in enumerate(product(range(seeds), range(len(arms)))):
            arm = arms[k]
            config = replace(arm.config, seed=seed)
            part = progress.part(done, total)
            report = _report_of(progress, done, total)
            fit = folder.first_frame(config, report)
            if not arm.first_alone:
                label = f"{arm.name} epochs{arm.point} seed{seed}".replace(" ", "-")
                fit = folder.continued(fit, label, config, report)
            fits.scores[k, seed] = fit.scores
            fits.calls[k, seed] = fit.clock.call
            fits.clocks.append(fit.clock)
            if fit.clock.call == folder.call:
                part(1, 1)
                on_fit(fits)
        progress(total, total)
    return fits


class _FitsFolder:
    """The folder of all fits of a capture.

    Args:
        capture: what is fitted.
        out: the folder.
        measure: as of `Vary`.
    """

    def __init__(self, capture: Capture, out: Path, measure: str) -> None:
        kind, _, network = measure.partition(":")
        self.call = moment()
        self._load = load_average()
        self._capture = capture
        self._out = out
        self._frame = next(capture.partial_frames(0, 1))
        self._network = network
        self._lpips = Lpips(network) if kind == "lpips" else None
        self._compiled: list[tuple[StreamConfig, int]] = []

    def first_frame(self, config: StreamConfig, report: Report) -> StoredFit:
        """Return the fit of the first frame with some settings."""
        first_config = first_frame_config(config)
        capture = replace(self._capture, num_frames=1)
        return self._fit(self._first_folder(config), capture, first_config, report)

    def continued(
        self, first: StoredFit, label: str, config: StreamConfig, report: Report
    ) -> StoredFit:
        """Return the fit with some settings that continues one of the first frame, in the folder
        with a name.
        """
        folder = self._out / quote(label, safe="")
        return self._fit(folder, self._capture, config, report, first)

    def _first_folder(self, config: StreamConfig) -> Path:
        text = repr(first_frame_config(replace(config, seed=0)))
        digest = sha256(text.encode()).hexdigest()[:_DIGEST]
        return self._out / f"first-frame-{digest}-seed{config.seed}"

    def _fit(
        self,
        folder: Path,
        capture: Capture,
        config: StreamConfig,
        report: Report,
        first: StoredFit | None = None,
    ) -> StoredFit:
        """Return a fit, made unless it is in its folder.

        Args:
            folder: its folder.
            capture: the frames that are fitted.
            config: its settings.
            report: called with its progress.
            first: fit of the first frame that it continues; None: it is one.
        """
        metadata = stream_metadata(capture, self._frame, with_border(capture, self._frame, config))
        made = json.loads(json.dumps([metadata, first.clock.date if first else None]))
        path = folder / "scores.json"
        fit = stored_fit(path) if path.exists() else StoredFit()
        if fit.made != made:
            report("Compiling kernels", 0, 1)
            self._compile_kernels(config, min(capture.num_frames, _WARM_FRAMES))
            stop = stopwatch(self.call, self._load)
            if first:
                begin_as(self._first_folder(config), folder, capture, metadata)
            stream_capture(capture, folder, config, first is not None, report)
            fit = StoredFit(made, stop())
        if fit.network != self._network:
            report("Evaluating", 1, 1)
            fit = replace(fit, network=self._network, scores=self._scores(folder))
            write_json(path, asdict(fit))
        return fit

    def _compile_kernels(self, config: StreamConfig, frames: int) -> None:
        """Fit some frames with few steps, once for all seeds of the same settings."""
        quick = apply_values(replace(config, seed=0), _WARM)
        if (quick, frames) in self._compiled:
            return
        self._compiled.append((quick, frames))
        loop = StreamLoop.of(self._dense_capture, quick)
        for frame in self._capture.partial_frames(0, frames):
            push_frame(loop, frame)

    @cached_property
    def _dense_capture(self) -> Capture:
        """The capture with points of its first images."""
        return with_points(self._capture, 0, Progress())

    def _scores(self, folder: Path) -> Sequence[float | None]:
        """Return the scores of the fit in a folder, means over its later frames if it has some."""
        result = evaluate_stream(folder, self._capture.path, lpips=self._lpips)
        rows = result.frames[1:] or result.frames
        scores = asdict(ViewScores.mean([row.scores for row in rows]))
        scores["first_seconds"] = result.seconds.first
        scores["seconds"] = result.seconds.per_later_frame
        scores["kilobytes"] = sum(row.num_bytes for row in rows) / len(rows) / 1e3
        return itemgetter(*SCORES)(scores)


def _report_of(progress: Progress, count: int, total: int) -> Report:
    """Return the report of one fit, which moves the bar of all fits and names the fit's stage.

    Args:
        progress: of all fits.
        count: number of fits before this one.
        total: number of fits.
    """
    share = 0.0

    def report(stage: str, done: float, stage_total: float) -> None:
        nonlocal share
        begin, end = _SPANS.get(name_of(stage), (share, share))
        share = begin + (end - begin) * done / stage_total
        progress.of(f"{progress.stage}, {stage.lower()}")(count + share, total)

    return report


def stored_fit(path: Path) -> StoredFit:
    """Return the fit in the file of its scores.

    Raises:
        ValueError: the file has something else.
    """
    try:
        entry = read_json(path)
        clock = Clock(**entry.pop("clock"))
        np.array(entry["scores"], float).reshape(len(SCORES))
        return StoredFit(clock=clock, **entry)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the scores of a fit, got a broken file ({error!r}); remove it, and "
            "the fit is made again."
        ) from None


def first_frame_config(config: StreamConfig) -> StreamConfig:
    """Return settings with those that only later frames use at their defaults: fits that agree in
    the rest have the same first frame.
    """
    default = StreamConfig()
    fit = replace(
        config.fit,
        epochs=default.fit.epochs,
        decay_means_rate=default.fit.decay_means_rate,
        rates=default.fit.rates,
        skip_static=default.fit.skip_static,
        confidence_steps=default.fit.confidence_steps,
        density=replace(config.fit.density, later_frames=default.fit.density.later_frames),
        objective=ObjectiveConfig(dssim_weight=config.fit.objective.dssim_weight),
    )
    render = replace(config.render, first_order_motion=default.render.first_order_motion)
    return replace(config, fit=fit, motion=default.motion, render=render)
