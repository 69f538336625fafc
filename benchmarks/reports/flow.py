"""Error and run time of optical flow: endpoint error for the true flow of synthetic clips.

The motion of a flow is compared as the loop uses it: both directions of two successive images, with the sign that
points from t - 1 to t on frame t's grid, and with the forward-backward check. All methods run in turn on each pair of
images, so that background load affects them equally. The first pair of the clip is run once before, as warm-up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.plots import blank_figure, markdown, save_figure
from benchmarks.reports.records import Record
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.method.flow import choose_key_views
from morgs_mi.method.flow_sources.consistency import consistency_mask
from morgs_mi.method.flow_sources.opencv import FLOW_METHODS
from morgs_mi.method.flow_sources.registry import FramePair, flow_source
from morgs_mi.synth.ground_truth import GroundTruth, load_truth

__all__ = [
    "FlowClip",
    "FlowErrors",
    "FlowReportConfig",
    "FlowResult",
    "FlowRow",
    "markdown_table",
    "plot_flow",
    "report_flow",
]

_NEAR = 1.0  # px


@dataclass(frozen=True)
class FlowReportConfig:
    """Methods and effort of the report on optical flow."""

    methods: tuple[str, ...] = tuple(FLOW_METHODS)
    """Sources of flow, as for `morgs-mi fit --flow`."""
    views: int = 4
    """Number of cameras, spread over the rig like key views."""
    frames: int | None = None
    """Maximum number of frames from the start."""

    def __post_init__(self) -> None:
        if not self.methods:
            raise ValueError("FlowReportConfig(): `methods` must name at least one, got none; add one.")
        for name, least in (("views", 1), ("frames", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"FlowReportConfig(): `{name}` must be at least {least}, got {value}; raise it.")


@dataclass(frozen=True)
class FlowErrors:
    """Errors of a method over all pixels or over the moving ones; NaN without such pixels."""

    error: float
    """Mean endpoint error, px."""
    within_1px: float
    """Share of the pixels with an error below 1 px."""
    reliable: float
    """Share of the pixels that pass the forward-backward check."""
    reliable_error: float
    """Mean endpoint error of the pixels that pass it, px."""


@dataclass(frozen=True)
class FlowRow:
    """Errors and run time of one method on one clip."""

    method: str
    ms: float
    """Median time of both directions of a pair, ms."""
    all: FlowErrors
    moving: FlowErrors


@dataclass(frozen=True)
class FlowClip:
    """Results of one clip."""

    name: str
    width: int
    """Width of the images, px."""
    height: int
    """Height of the images, px."""
    pairs: int
    """Number of pairs of images."""
    motion: float
    """Mean length of the true motion of moving pixels, px."""
    rows: tuple[FlowRow, ...]
    """One row per method."""


@dataclass(frozen=True)
class FlowResult(Record):
    """Results of the report on optical flow."""

    clips: tuple[FlowClip, ...]
    settings: Mapping[str, Any]
    machine: Mapping[str, Any]
    versions: Mapping[str, str]


def report_flow(
    captures: Sequence[str | Path],
    config: FlowReportConfig,
    progress: Callable[[str, float, float], None] = lambda *_: None,
) -> FlowResult:
    """Measure every method on every clip.

    Args:
        captures: folders of captures with ground truth.
        config: methods and effort.
        progress: called with (stage, done, total).

    Returns:
        One clip per capture, the settings, the machine and the versions.

    Raises:
        OSError: a capture or its ground truth cannot be read.
        ValueError: there is no capture, a capture has no ground truth or a single frame, or as `flow_source`.
    """
    if not captures:
        raise ValueError("report_flow(): `captures` must name at least one folder, got none.")
    clips = tuple(_clip(load_capture(path, max_frames=config.frames), config, progress) for path in captures)
    return FlowResult(clips, asdict(config), machine(), versions())


def markdown_table(clip: FlowClip) -> str:
    """Return one clip's rows as a table."""
    titles = (
        "method",
        "ms",
        "error, px",
        "moving",
        "within 1 px",
        "moving",
        "reliable",
        "moving",
        "their error",
        "moving",
    )
    rows = []
    for row in clip.rows:
        both = (row.all, row.moving)
        cells = [f"`{row.method}`", f"{row.ms:.1f}"]
        cells += [_cell(figures.error, "{:.2f}") for figures in both]
        cells += [_cell(getattr(figures, name), "{:.1%}") for name in ("within_1px", "reliable") for figures in both]
        cells += [_cell(figures.reliable_error, "{:.2f}") for figures in both]
        rows.append(cells)
    return markdown(titles, rows)


def plot_flow(result: FlowResult, path: str | Path) -> None:
    """Plot the error of moving pixels over run time, one panel per clip, with and without the check.

    Raises:
        ValueError: matplotlib is not installed.
    """
    clips = result.clips
    figure = blank_figure(6.2 * len(clips), 4.8)
    for axis, clip in zip(figure.subplots(1, len(clips), squeeze=False).flat, clips, strict=True):
        for row in clip.rows:
            moving = row.moving
            (line,) = axis.plot(row.ms, moving.error, "o", markersize=7, label=row.method)
            axis.plot(row.ms, moving.reliable_error, "v", color=line.get_color(), fillstyle="none")
            axis.plot([row.ms] * 2, [moving.error, moving.reliable_error], color=line.get_color(), alpha=0.3)
        axis.set(
            title=f"{clip.name}, {clip.width}x{clip.height}, motion of {clip.motion:.1f} px",
            xlabel="both directions of a pair, ms",
            ylabel="mean endpoint error of moving pixels, px",
            xscale="log",
        )
        axis.margins(x=0.2, y=0.1)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3, which="both")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    marks = [figure.axes[0].plot([], [], *style)[0] for style in (("ko",), ("kv",))]
    marks[1].set_fillstyle("none")
    labels += ["all moving pixels", "moving pixels that pass the check"]
    figure.legend(handles + marks, labels, loc="outside lower center", ncols=5, fontsize=8)
    save_figure(figure, path)


def _cell(value: float, form: str) -> str:
    return form.format(value) if value == value else "-"


def _clip(capture: Capture, config: FlowReportConfig, progress: Callable[[str, float, float], None]) -> FlowClip:
    """Return the results of one clip."""
    name = capture.path.resolve().name
    if capture.truth is None or capture.num_frames < 2:
        raise ValueError(
            f"{capture.path}: expected a capture of two frames or more with ground truth, got {capture.num_frames} "
            f"frames and {'a' if capture.truth else 'no'} folder truth; make one with morgs-mi synth."
        )
    views = choose_key_views(capture.cameras, config.views)
    sources = {method: flow_source(method) for method in config.methods}
    found: dict[str, list[dict[str, Any]]] = {method: [] for method in sources}
    total, motions = (capture.num_frames - 1) * len(views), []
    for done, (pair, truth) in enumerate(_pairs(capture, views)):
        progress(f"Flow of {name}", done, total)
        motions.append(np.linalg.norm(truth.motion[truth.mask], axis=-1))
        for method, source in sources.items():
            if not done:
                source(pair)
            start = time.perf_counter()
            flow, forward_flow = source(pair)
            milliseconds = 1e3 * (time.perf_counter() - start)
            found[method].append({"ms": milliseconds, **_errors(-flow, consistency_mask(flow, forward_flow), truth)})
    progress(f"Flow of {name}", total, total)
    camera = capture.cameras[views[0]]
    return FlowClip(
        name=name,
        width=camera.width,
        height=camera.height,
        pairs=total,
        motion=round(float(np.concatenate(motions).mean()), 2),
        rows=tuple(_row(method, pairs) for method, pairs in found.items()),
    )


def _pairs(capture: Capture, views: Sequence[int]) -> Iterator[tuple[FramePair, GroundTruth]]:
    """Yield the successive images of each selected view, with the truth on the later image's grid."""
    assert capture.truth is not None
    for previous, frame in pairwise(capture.frames()):
        for view in views:
            camera = capture.cameras[view].name
            pair = FramePair(frame.images[view], previous.images[view], camera, frame.index, capture.masks[view])
            yield pair, load_truth(capture.truth, camera, frame.index)


def _errors(motion: np.ndarray, reliable: np.ndarray, truth: GroundTruth) -> dict[str, dict[str, float]]:
    """Return sums over the pixels of one image, by subset, so that images can be added up."""
    error = np.linalg.norm(motion.astype(np.float64) - truth.motion, axis=-1)
    figures = {}
    for name, subset in (("all", np.ones_like(truth.mask)), ("moving", truth.mask)):
        figures[name] = {
            "pixels": int(subset.sum()),
            "error": float(error[subset].sum()),
            "within_1px": int((error[subset] < _NEAR).sum()),
            "reliable": int((subset & reliable).sum()),
            "reliable_error": float(error[subset & reliable].sum()),
        }
    return figures


def _row(method: str, pairs: Sequence[dict[str, Any]]) -> FlowRow:
    """Return the errors and the time of a method from those of its pairs."""
    errors = {}
    for subset in ("all", "moving"):
        total = {name: sum(pair[subset][name] for pair in pairs) for name in pairs[0][subset]}
        pixels, reliable = total["pixels"] or np.nan, total["reliable"] or np.nan
        errors[subset] = FlowErrors(
            error=round(total["error"] / pixels, 4),
            within_1px=round(total["within_1px"] / pixels, 4),
            reliable=round(total["reliable"] / pixels, 4),
            reliable_error=round(total["reliable_error"] / reliable, 4),
        )
    return FlowRow(method, round(float(np.median([pair["ms"] for pair in pairs])), 2), **errors)
