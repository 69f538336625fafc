"""Error and run time of optical flow: endpoint error for the true flow of synthetic clips.

    python -m benchmarks.reports flow CAPTURE... --json out.json --plot out.png

The motion of a flow is compared as the loop uses it: both directions of two successive images, with the sign that
points from t - 1 to t on frame t's grid, and with the forward-backward check. All methods run in turn on each pair of
images: background load affects them equally. The first pair of the clip is run once before, as warm-up.

A clip of the JSON has one row per method: the median time of both directions of a pair in `ms`, and, for `all` and for
the `moving` pixels, the mean endpoint `error` in px, the share `within_1px`, and the share and the error of the
`reliable` pixels, those that pass the forward-backward check.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from benchmarks.reports.plots import Column, blank_figure, save_figure, scores_table
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.truth import GroundTruth, load_truth
from morgs_mi.core.rig import choose_key_views
from morgs_mi.method.flow_sources.consistency import consistency_mask
from morgs_mi.method.flow_sources.flow_registry import FramePair, flow_source
from morgs_mi.method.flow_sources.opencv_flow import FLOW_METHODS

_NEAR = 1.0  # px


@dataclass(frozen=True, kw_only=True)
class Options(Output):
    """Measure error and run time of optical flow on synthetic clips."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures with ground truth, as written by synth."""
    plot: Path | None = None
    """Plot of error over run time, .png or .svg; needs matplotlib."""
    methods: tuple[str, ...] = tuple(FLOW_METHODS)
    """Sources of flow, as for `morgs-mi fit --flow`."""
    views: int = 4
    """Number of cameras, spread over the rig like key views."""
    frames: int | None = None
    """Maximum number of frames from the start."""

    def run(self) -> None:
        """Measure every method on every clip, print the tables, and write the figures."""
        if not self.captures or not self.methods:
            raise ValueError("flow: `captures` and `methods` must name at least one each, got none; add one.")
        recordings = (load_capture(path, max_frames=self.frames) for path in self.captures)
        clips = [measure(capture, self.methods, self.views) for capture in recordings]
        for clip in clips:
            title = "{name}: {pairs} pairs of {width}x{height} pixels, motion of {motion:.1f} px".format(**clip)
            print(f"{title}\n\n{errors_table(clip['rows'])}")
        if self.plot is not None:
            plot_flow(clips, self.plot)
        settings = {"methods": self.methods, "views": self.views, "frames": self.frames}
        self.write({"clips": clips, "settings": settings}, unprinted=["clips"])


def columns() -> Iterator[Column]:
    """Yield the columns of the table: each score of all and of the moving pixels."""
    yield Column("ms", "ms", 1, spread=False)
    scores = (("error, px", "error", 2, 1, ""), ("within 1 px", "within_1px", 1, 100, "%"))
    scores += (("reliable", "reliable", 1, 100, "%"), ("their error", "reliable_error", 2, 1, ""))
    for title, score, decimals, factor, unit in scores:
        for subset, head in (("all", title), ("moving", "moving")):
            yield Column(head, lambda row, s=subset, name=score: row[s][name], decimals, factor, unit, spread=False)


def errors_table(rows: Sequence[Row]) -> str:
    """Return one clip's rows as a table."""
    return scores_table(rows, {"method": lambda row: f"`{row['method']}`"}, list(columns()))


def plot_flow(clips: Sequence[Row], path: Path) -> None:
    """Plot the error of moving pixels over run time, one panel per clip, with and without the check.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = blank_figure(6.2 * len(clips), 4.8)
    for axis, clip in zip(figure.subplots(1, len(clips), squeeze=False).flat, clips, strict=True):
        for row in clip["rows"]:
            moving, ms = row["moving"], row["ms"]
            (line,) = axis.plot(ms, moving["error"], "o", markersize=7, label=row["method"])
            axis.plot(ms, moving["reliable_error"], "v", color=line.get_color(), fillstyle="none")
            axis.plot([ms] * 2, [moving["error"], moving["reliable_error"]], color=line.get_color(), alpha=0.3)
        axis.set(
            title="{name}, {width}x{height}, motion of {motion:.1f} px".format(**clip),
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


def measure(capture: Capture, methods: Sequence[str], num_views: int) -> dict[str, Any]:
    """Return the results of one clip.

    Raises:
        ValueError: the capture has no ground truth or a single frame, or as `flow_source`.
    """
    name = capture.path.resolve().name
    if capture.truth is None or capture.num_frames < 2:
        raise ValueError(
            f"{capture.path}: expected a capture of two frames or more with ground truth, got {capture.num_frames} "
            f"frames and {'a' if capture.truth else 'no'} folder truth; make one with morgs-mi synth."
        )
    views = choose_key_views(capture.cameras, num_views)
    sources = {method: flow_source(method) for method in methods}
    found: dict[str, list[dict[str, Any]]] = {method: [] for method in sources}
    motions = []
    for done, (pair, truth) in enumerate(_pairs(capture, views)):
        motions.append(np.linalg.norm(truth.motion[truth.mask], axis=-1))
        for method, source in sources.items():
            if not done:
                source(pair)
            start = time.perf_counter()
            flow, forward_flow = source(pair)
            milliseconds = 1e3 * (time.perf_counter() - start)
            found[method].append({"ms": milliseconds, **_errors(-flow, consistency_mask(flow, forward_flow), truth)})
    camera = capture.cameras[views[0]]
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "pairs": len(motions),
        "motion": round(float(np.concatenate(motions).mean()), 2),
        "rows": [_row(method, pairs) for method, pairs in found.items()],
    }


def _pairs(capture: Capture, views: Sequence[int]) -> Iterator[tuple[FramePair, GroundTruth]]:
    """Yield the successive images of each selected view, with the truth on the later image's grid."""
    assert capture.truth is not None
    for previous, frame in pairwise(capture.frames()):
        for view in views:
            camera = capture.cameras[view].name
            pair = FramePair(frame.images[view], previous.images[view], camera, frame.index, capture.masks[view])
            yield pair, load_truth(capture.truth, camera, frame.index)


def _errors(motion: np.ndarray, reliable: np.ndarray, truth: GroundTruth) -> dict[str, dict[str, float]]:
    """Return sums over the pixels of one image, by subset."""
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


def _row(method: str, pairs: Sequence[Row]) -> dict[str, Any]:
    """Return the errors and the time of a method, given the sums of its pairs."""
    row: dict[str, Any] = {"method": method, "ms": round(float(np.median([pair["ms"] for pair in pairs])), 2)}
    for subset in ("all", "moving"):
        total = {name: sum(pair[subset][name] for pair in pairs) for name in pairs[0][subset]}
        pixels, reliable = total.pop("pixels") or np.nan, total["reliable"] or np.nan
        shares = {name: value / (reliable if name == "reliable_error" else pixels) for name, value in total.items()}
        row[subset] = {name: round(value, 4) for name, value in shares.items()}
    return row
