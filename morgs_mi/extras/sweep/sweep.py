"""Error against run time of a capture, and the parts of the method that it does not need.

An arm is the method with some settings, under a name. All arms of a seed continue the same fit of
the first frame, so they differ in later frames alone. Fits that are in the folder of the results,
of the same capture and with the same settings, are not made again.
"""

from __future__ import annotations

import base64
import html
import json
import time
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import decode
from morgs_mi.core.bounded import read_json
from morgs_mi.core.config import Count, apply_values, check_value, config_or_default
from morgs_mi.core.environment import machine, versions
from morgs_mi.core.files import locked_folder, write_json
from morgs_mi.core.interrupts import interrupts_raised
from morgs_mi.core.plots import check_plot
from morgs_mi.core.progress import Progress, Report
from morgs_mi.evaluate.comparison import ComparedClip
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.results import ViewScores, known_mean
from morgs_mi.extras.sweep.plot import draw_sweep
from morgs_mi.loop.stream_config import PresetName, StreamConfig, apply_preset
from morgs_mi.playback.streams import open_stream
from morgs_mi.runs.fit_capture import begin_as, push_frame, stream_capture, with_points
from morgs_mi.runs.fit_files import stream_metadata
from morgs_mi.stream_loop import StreamLoop

PARTS = {
    "flow guidance": "motion.learn_motion = false",
    "flow loss": "fit.objective.flow_weight = 0.0",
    "offset": "motion.learn_offset = false",
    "confidence": "motion.learn_confidence = false",
    "masks": "fit.objective.mask_weight = 0.0\nfit.confidence_steps = 0",
    "propagation": "motion.propagate_motion = false",
    "search": "motion.search_motion = false",
    "refinement": "motion.refine_start = false",
    "density control": "fit.density.rounds = 0\nfit.density.later_frames = false",
    "SH above 0": "fit.sh_degree = 0",
    "exposure": 'fit.exposure = "off"',
    "active set": "fit.skip_static = false",
}
"""Parts of the method that can be left out, with the settings that do so. Without flow guidance,
the motion starts from zero as well.
"""
TITLES = ("first, s", "later, s", "PSNR, dB", "moving, dB", "motion error, px", "kB")
"""Titles of the scores: seconds of the first frame, and of a later one; PSNR of the images and of
moving pixels; endpoint error of the motion where surfaces move; kilobytes of a later frame.
"""
# Parts that act on the first frame.
_FIRST_PARTS = {"density control", "SH above 0", "exposure"}
# The first frame and two later ones, with masks, compile the kernels of an arm.
_WARM_FRAMES = 3
_WARM = {"fit": {"first_frame_steps": 60, "epochs": 2}, "motion": {"mask_interval": 1}}
# Share by which seconds, motion error and bytes may grow without a part that is not needed.
_COST_TOLERANCE = 0.05


# Name, settings, and whether the arm continues the first frame that most share.
Arm = tuple[str, StreamConfig, bool]


@dataclass(frozen=True, eq=False)
class SweepResult:
    """Scores of fits of a capture by several arms. In a notebook it is a table and a plot."""

    capture: str  #: Name of the capture.
    held_out: bool  #: Whether held-out views are scored; otherwise all training views.
    arms: Sequence[str]  #: Names of the A arms; an arm with another number of epochs is another.
    epochs: Sequence[int]  #: Their numbers of epochs.
    #: Scores [A, S, 6] of S seeds, in the order of `TITLES`; NaN where unknown. All but the seconds
    #: of the first frame are means over the later frames.
    scores: np.ndarray
    #: Of each seed, pairs while the first frame was fitted: seconds, and PSNR in dB.
    first_frames: Sequence[Sequence[tuple[float, float]]]
    #: Titles, then means over the seeds ± standard deviations; of `leave_out`, differences from the
    #: arm with all parts.
    table: Sequence[Sequence[str]] = ()
    sentence: str = ""  #: Parts that the scene does not need, of `leave_out`.
    toml: str = ""  #: Settings that leave them out.

    def plot(self, path: str | Path) -> None:
        """Draw the scores over the seconds of a later frame, a curve for each arm.

        Raises:
            ValueError: as `check_plot`.
            OSError: the file cannot be written.
        """
        path = Path(path)
        check_plot(path)
        draw_sweep(self).savefig(path)

    def _repr_html_(self) -> str:
        rows = ("".join(f"<td>{html.escape(cell)}" for cell in row) for row in self.table)
        text = f"<table><tr>{'<tr>'.join(rows)}</table>{html.escape(self.sentence)}"
        with suppress(ImportError):
            data = BytesIO()
            draw_sweep(self).savefig(data)
            image = base64.b64encode(data.getvalue()).decode()
            text += f'<img alt="Scores over seconds" src="data:image/png;base64,{image}">'
        return f"{text}<pre>{self.toml}</pre>"


@interrupts_raised()
def sweep(
    capture: Capture,
    presets: Sequence[PresetName | Literal["default"]] = ("baseline", "default"),
    epochs: Sequence[int] = (1, 2, 4, 8),
    seeds: int = 3,
    frames: int = 8,
    out: str | Path = "sweep",
    config: StreamConfig | None = None,
    progress: Report | None = None,
) -> SweepResult:
    """Fit and evaluate a capture with each preset, number of epochs and seed: error against run
    time.

    OUT/baseline-epochs4-seed0 etc. have the streams, OUT/sweep.json the result with machine and
    versions. Fits that are there, of the same capture and with the same settings, are not made
    again; others of these names are replaced.

    Args:
        capture: the capture.
        presets: names of presets, or "default" for `config` as it is.
        epochs: passes over the views for every later frame.
        seeds: number of seeds 0, 1, ....
        frames: most frames that are fitted, from the first one, at least two.
        out: folder.
        config: settings that the presets change.
        progress: called with (stage, done, total).

    Raises:
        ValueError: a number is too small, a preset is unknown, or as `stream_capture`.
        OSError: as `stream_capture`.
    """
    config = config_or_default("sweep()", config, StreamConfig())
    arms = []
    for preset in presets:
        method = config if preset == "default" else apply_preset(config, preset)
        for count in sorted({*epochs}):
            arms.append((preset, replace(method, fit=replace(method.fit, epochs=count)), True))
    result = fit_arms(arms, config, capture, seeds, frames, Path(out), progress)
    table = [
        [arm, str(count), *_cells(scores)]
        for arm, count, scores in zip(result.arms, result.epochs, result.scores, strict=True)
    ]
    return _written(result, Path(out) / "sweep.json", [["arm", "epochs", *TITLES], *table])


@interrupts_raised()
def leave_out(
    capture: Capture,
    tolerance: float = 0.05,
    seeds: int = 3,
    frames: int = 8,
    out: str | Path = "sweep",
    config: StreamConfig | None = None,
    progress: Report | None = None,
) -> SweepResult:
    """Fit and evaluate a capture without each of the `PARTS` of the method that `config` uses, and
    without all together that it does not need.

    A part is not needed if, without it, the PSNR of the images and that of their moving pixels fall
    by at most `tolerance`, and the motion error, the seconds and the bytes of a later frame rise by
    at most 5 %, in the mean over the seeds.
    Parts may stand in for each other: while those that are not needed alone are needed together,
    the one that costs most PSNR stays in.

    A part that acts on the first frame has another fit of it. OUT/without-search-epochs8-seed0 etc.
    have the streams, OUT/leave-out.json the result, and OUT/leave-out.toml the settings that leave
    out what is not needed, for `fit --config`.

    Args:
        capture: the capture.
        tolerance: in dB.
        seeds: as for `sweep`, like all that follow.
        frames: most frames that are fitted.
        out: folder.
        config: settings with all parts.
        progress: called with (stage, done, total).

    Raises:
        ValueError: as `sweep`.
        OSError: as `sweep`.
    """
    config = config_or_default("leave_out()", config, StreamConfig())
    common = (config, capture, seeds, frames, Path(out), progress)

    def without(parts: Sequence[str]) -> Arm:
        method = apply_values(config, tomllib.loads(_toml(parts)))
        return f"without {', '.join(parts)}", method, _FIRST_PARTS.isdisjoint(parts)

    parts = [part for part in PARTS if without([part])[1] != config]
    arms = [("all parts", config, True), *(without([part]) for part in parts)]
    result = fit_arms(arms, *common)
    needed = _are_needed(result, tolerance)
    left_out = [part for part, is_needed in zip(parts, needed[1:], strict=True) if not is_needed]
    while len(left_out) > 1:
        result = fit_arms([*arms, without(left_out)], *common)
        needed = _are_needed(result, tolerance)
        if not needed[-1]:
            break
        losses = result.scores.mean(1)[:, 2]
        left_out.remove(min(left_out, key=lambda part: losses[1 + parts.index(part)]))
    changes = result.scores - result.scores[:1]
    table = [["", *TITLES, "needed"], [result.arms[0], *_cells(result.scores[0]), ""]]
    for k in range(1, len(changes)):
        name = shorten(result.arms[k], 40)
        table.append([name, *_cells(changes[k], "+"), "yes" if needed[k] else "no"])
    sentence = f"Within {tolerance:g} dB, this scene needs each of the parts."
    if left_out:
        k = result.arms.index(without(left_out)[0])
        _, seconds, *_ = _cells(result.scores[k])
        sentence = (
            f"Within {tolerance:g} dB, this scene does not need {', '.join(left_out)}: without, a "
            f"later frame takes {seconds} s instead of {table[1][2]} s, and its PSNR changes by "
            f"{table[k + 1][3]} dB."
        )
    toml = _toml(left_out)
    (Path(out) / "leave-out.toml").write_text(toml, encoding="utf-8")
    return _written(result, Path(out) / "leave-out.json", table, sentence, toml)


def _are_needed(result: SweepResult, tolerance: float) -> np.ndarray:
    """Return, for each arm, whether the parts that it lacks are needed; see `leave_out`."""
    means = result.scores.mean(1)
    changes = means - means[0]
    loss = -np.fmin(changes[:, 2], changes[:, 3])
    costs = [1, 4, 5]
    # Comparisons with unknown scores are false.
    return (loss > tolerance) | (changes[:, costs] > _COST_TOLERANCE * means[0, costs]).any(1)


def _toml(parts: Sequence[str]) -> str:
    """Return the settings that leave out some parts."""
    return "".join(f"{PARTS[part]}\n" for part in parts)


def _cells(scores: np.ndarray, sign: str = "-") -> list[str]:
    """Return the means of scores [S, N] ± their standard deviations over the seeds, "-" if
    unknown.
    """
    cells = []
    for values in scores.T:
        spread = f" ± {values.std(ddof=1):.2f}" if len(values) > 1 else ""
        cells.append("-" if np.isnan(values).any() else f"{values.mean():{sign}.2f}{spread}")
    return cells


def fit_arms(
    arms: Sequence[Arm],
    first_config: StreamConfig,
    capture: Capture,
    seeds: int,
    frames: int,
    out: Path,
    progress: Report | None,
) -> SweepResult:
    """Return the scores of some arms, fitted where they are missing. They are fitted seed by seed,
    so that a change of the machine's load reaches all of them.
    """
    check_value("sweep()", "seeds", seeds, Count)
    check_value("sweep()", "frames", frames, Annotated[int, Ge(2)])
    capture = replace(capture, num_frames=min(frames, capture.num_frames))
    frame = next(capture.partial_frames(0, 1))

    @cache
    def dense_capture() -> Capture:
        return with_points(capture, first_config.seed, Progress())

    @cache
    def compile_kernels(config: StreamConfig) -> None:
        loop = StreamLoop.of(dense_capture(), config)
        for frame in capture.partial_frames(0, _WARM_FRAMES):
            push_frame(loop, frame, capture.train_views)

    def scores_of(folder: Path, config: StreamConfig, start: Any, fit: Callable[..., Any]) -> Any:
        """Return the scores of a fit, made unless they are there of the same capture, settings and
        start.
        """
        path = folder / "scores.json"
        metadata = stream_metadata(capture, frame, config)
        made = json.loads(json.dumps([metadata, start]))
        if not path.exists() or stored_scores(path)[0] != made:
            compile_kernels(replace(apply_values(config, _WARM), seed=0))
            write_json(path, {"made": made, "scores": fit(folder, config, metadata)})
        return stored_scores(path)[1]

    def fit_first(folder: Path, config: StreamConfig, _: Any) -> list[list[float]]:
        shown = []
        begin = time.perf_counter()

        def show(keyframe: Packet | None) -> None:
            shown.append((time.perf_counter() - begin, keyframe))

        stream_capture(replace(capture, num_frames=1), folder, config, on_provisional=show)
        show(next(iter(open_stream(folder))))
        (frame,) = ComparedClip.of(open_stream(folder), capture.path).frames()
        curve = []
        for seconds, keyframe in shown:
            state = replace(frame.state, gaussians=decode(None, keyframe).gaussians)
            views = replace(frame, state=state).views()
            scores = [psnr(view.rendered, view.recorded, view.valid) for view in views]
            curve.append([seconds, known_mean(scores)])
        return curve

    first_frames = []
    scores = np.full((len(arms), seeds, len(TITLES)), np.nan)
    fits = Progress(progress, "Fitting and evaluating")
    total = seeds * len(arms)
    with locked_folder(out, "sweep()"):
        for seed in range(seeds):
            first = out / f"first-seed{seed}"
            curve = scores_of(first, replace(first_config, seed=seed), None, fit_first)
            first_frames.append(curve)
            for k, (name, config, shares_first) in enumerate(arms):
                label = f"{name}-epochs{config.fit.epochs}-seed{seed}"
                folder = out / label.replace(", ", "+").replace(" ", "-")
                start = first if shares_first else None
                fit = partial(_fit_later, capture, start, fits.part(seed * len(arms) + k, total))
                scores[k, seed] = scores_of(folder, replace(config, seed=seed), curve, fit)
        fits(total, total)
    names, configs, _ = zip(*arms, strict=True)
    epochs = [config.fit.epochs for config in configs]
    return SweepResult(
        capture.path.name, bool(capture.test_views), names, epochs, scores, first_frames
    )


def stored_scores(path: Path) -> tuple[Any, list[Any]]:
    """Return what a fit was made of, and its scores: a number for each of `TITLES`, or the pairs of
    `SweepResult.first_frames`.

    Raises:
        ValueError: the file has something else.
    """
    try:
        document = read_json(path)
        made = document["made"]
        scores = document["scores"]
        rows = np.array(scores, float)  # None is NaN
        if rows.shape not in ((len(TITLES),), (len(scores), 2)):
            raise ValueError(f"numbers {list(rows.shape)}")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected the scores of a fit, got a broken file ({error!r}); remove it, and "
            "the fit is made again."
        ) from None
    return made, scores


def _fit_later(
    capture: Capture,
    first: Path | None,
    progress: Progress,
    folder: Path,
    config: StreamConfig,
    metadata: dict[str, Any],
) -> list[float | None]:
    """Fit an arm, from the first frame in a folder if there is one; return its scores."""
    if first is not None:
        begin_as(first, folder, capture, metadata)
    stream_capture(capture, folder, config, first is not None, progress.report)
    result = evaluate_stream(folder, capture.path)
    progress(1, 1)
    later = ViewScores.mean([frame.scores for frame in result.frames[1:]])
    return [
        result.seconds.first,
        result.seconds.per_later_frame,
        later.psnr,
        later.psnr_moving,
        later.motion_error_moving,
        result.sizes.per_residual / 1e3,
    ]


def _written(
    result: SweepResult,
    path: Path,
    table: Sequence[Sequence[str]],
    sentence: str = "",
    toml: str = "",
) -> SweepResult:
    """Return a result with its table, and write it as JSON with machine and versions."""
    result = replace(result, table=table, sentence=sentence, toml=toml)
    entries = {"titles": TITLES, "scores": result.scores.tolist()}
    write_json(path, asdict(result) | entries | {"machine": machine(), "versions": versions()})
    return result
