"""The fits of a sweep, seed by seed and arm by arm, each of which is made once."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from hashlib import sha256
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.bounded import read_json
from morgs_mi.core.config import apply_values
from morgs_mi.core.extras import extra
from morgs_mi.core.files import locked_folder, write_json
from morgs_mi.core.progress import Progress, Report
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.results import ViewScores
from morgs_mi.extras.sweep.clock import Clock, load_average, moment, stopwatch
from morgs_mi.extras.sweep.statistics import SCORES
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.objective import ObjectiveConfig
from morgs_mi.runs.fit_capture import begin_as, push_frame, stream_capture, with_points
from morgs_mi.runs.fit_files import stream_metadata
from morgs_mi.stream_loop import StreamLoop

# The first frame and two later ones, with masks, compile the kernels of an arm.
_WARM_FRAMES = 3
_WARM = {"fit": {"first_frame_steps": 60, "epochs": 2}, "motion": {"mask_interval": 1}}
# Digits of the digest in the name of a first frame's folder.
_DIGEST = 8
_NO_CLOCK = Clock()


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
class Fit:
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
    frame = next(capture.partial_frames(0, 1))
    call = moment()
    load = load_average()
    kind, _, network = measure.partition(":")
    lpips = extra("image distances", "lpips")(network) if kind == "lpips" else None

    @cache
    def dense_capture() -> Capture:
        return with_points(capture, 0, Progress())

    @cache
    def compile_kernels(config: StreamConfig, frames: int) -> None:
        loop = StreamLoop.of(dense_capture(), config)
        for frame in capture.partial_frames(0, min(frames, _WARM_FRAMES)):
            push_frame(loop, frame, capture.train_views)

    def make_fit(
        folder: Path, config: StreamConfig, start: Fit | None = None, report: Report | None = None
    ) -> Fit:
        """Return a fit, made unless it is in its folder.

        Args:
            folder: its folder.
            config: its settings.
            start: fit of the first frame that it continues; None: it is one.
            report: called with its progress.
        """
        clip = capture if start else replace(capture, num_frames=1)
        metadata = stream_metadata(clip, frame, config)
        made = json.loads(json.dumps([metadata, start.clock.date if start else None]))
        path = folder / "scores.json"
        fit = stored_fit(path) if path.exists() else Fit()
        if fit.made != made:
            compile_kernels(apply_values(replace(config, seed=0), _WARM), clip.num_frames)
            stop = stopwatch(call, load)
            if start:
                begin_as(first_folder(config), folder, clip, metadata)
            stream_capture(clip, folder, config, start is not None, report)
            fit = Fit(made, stop())
        if fit.network != network:
            fit = replace(fit, network=network, scores=scores_of(folder))
            write_json(path, asdict(fit))
        return fit

    def scores_of(folder: Path) -> Sequence[float | None]:
        result = evaluate_stream(folder, capture.path, lpips=lpips)
        rows = result.frames[1:] or result.frames
        scores = asdict(ViewScores.mean([row.scores for row in rows]))
        scores["first_seconds"] = result.seconds.first
        scores["seconds"] = result.seconds.per_later_frame
        scores["kilobytes"] = sum(row.num_bytes for row in rows) / len(rows) / 1e3
        return itemgetter(*SCORES)(scores)

    def first_folder(config: StreamConfig) -> Path:
        text = repr(first_frame_config(replace(config, seed=0)))
        digest = sha256(text.encode()).hexdigest()[:_DIGEST]
        return out / f"first-frame-{digest}-seed{config.seed}"

    fits = Fits.of(len(arms), seeds)
    total = seeds * len(arms)
    with locked_folder(out, "sweep()"), ExitStack() as at_end:
        at_end.callback(on_fit, fits)
        for done, (seed, k) in enumerate(product(range(seeds), range(len(arms)))):
            arm = arms[k]
            config = replace(arm.config, seed=seed)
            part = progress.part(done, total)
            fit = make_fit(first_folder(config), first_frame_config(config))
            if not arm.first_alone:
                label = f"{arm.name} epochs{arm.point} seed{seed}".replace(" ", "-")
                fit = make_fit(out / quote(label, safe=""), config, fit, part.report)
            fits.scores[k, seed] = fit.scores
            fits.calls[k, seed] = fit.clock.call
            fits.clocks.append(fit.clock)
            if fit.clock.call == call:
                part(1, 1)
                on_fit(fits)
        progress(total, total)
    return fits


def stored_fit(path: Path) -> Fit:
    """Return the fit in the file of its scores.

    Raises:
        ValueError: the file has something else.
    """
    try:
        entry = read_json(path)
        clock = Clock(**entry.pop("clock"))
        np.array(entry["scores"], float).reshape(len(SCORES))
        return Fit(clock=clock, **entry)
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
