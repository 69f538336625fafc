"""Bytes, quality and time of the codec at several quality settings, compared with lzma over raw
residuals.

    python -m benchmarks.reports codec CAPTURE... --out out/codec --json out.json --plot out.png

Each setting fits the clip again, because the next frame starts from what the codec has quantised.
Fits of one setting differ by some hundredths of a dB; smaller differences are not significant.

A clip of the JSON has one row per `quality`, the reference last: the PSNR of the `later` frames in
dB; the bytes of a `later` frame, and of its float32 residual with `lzma`; the median times to
encode a later frame, and of lzma, in ms; and the `loss` of PSNR against the reference in dB.
Figures of later frames are means. lzma benefits from values that were rounded to zero; in the
reference stream there are none.
"""

from __future__ import annotations

import lzma
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from benchmarks.reports.plots import Column, blank_figure, label_points, save_figure, scores_table
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.packets import CodedFrame, coded_frames, residual_packet
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.streams import open_stream
from morgs_mi.runs.fit_capture import stream_capture

# The best preset of lzma takes several times as long and saves a few percent.
_LZMA_PRESET = 6
# Quality of the stream that serves as the uncompressed reference.
_REFERENCE = 1000
_LABELS = "stream", "lzma over float32 residuals"
COLUMNS = (
    Column("PSNR, dB", lambda row: row["psnr"]["later"], spread=False),
    Column("loss, dB", lambda row: round(row["loss"], 2) + 0.0, spread=False),
    Column("kB", "later", 1, 1e-3, spread=False),
    Column("kB by lzma", "lzma", 1, 1e-3, spread=False),
)


@dataclass(frozen=True, kw_only=True)
class Options(Output):
    """Measure bytes, quality and time of the codec, compared with lzma over raw residuals."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures; each is fitted once per quality."""
    out: Path = Path("out/codec")
    """Output folder for the streams, which stay in OUT/CLIP/QUALITY."""
    plot: Path | None = None
    """Plot of quality and time over bytes, .png or .svg; needs matplotlib."""
    qualities: tuple[float, ...] = (0.5, 1, 2, 4)
    """Values of `codec.quality`."""
    stream: StreamConfig = field(default_factory=StreamConfig)
    """Settings of the fit."""

    def run(self) -> None:
        """Fit every capture with every quality, measure the streams, print the tables, and write
        the figures.
        """
        clips = [measure(load_capture(path), self) for path in self.captures]
        print(quality_table(clips))
        if self.plot is not None:
            plot_codec(clips, self.plot)
        settings = {"qualities": self.qualities, "stream": asdict(self.stream)}
        self.write({"clips": clips, "settings": settings}, unprinted=["clips", "settings"])


def measure(capture: Capture, options: Options) -> dict[str, Any]:
    """Fit a capture with every quality, and return the figures of the streams.

    Raises:
        ValueError: as `stream_capture` and `evaluate_stream`.
    """
    name = capture.path.resolve().name
    rows = []
    for quality in (*options.qualities, _REFERENCE):
        config = replace(options.stream, codec=replace(options.stream.codec, quality=quality))
        folder = options.out / name / f"{quality:g}"
        stream_capture(capture, folder, config)
        print(f"{name} at quality {quality:g}", flush=True)
        later_frames = evaluate_stream(folder, capture.path).frames[1:]
        stream = open_stream(folder)
        frames = [
            _frame(old_state, state, stream.cameras, config)
            for old_state, state in pairwise(coded_frames(stream))
        ]
        times = {
            key: float(np.median([row[key] for row in frames])) for key in ("encode_ms", "lzma_ms")
        }
        rows.append(
            {
                "quality": quality,
                "psnr": {"later": float(np.mean([row.scores.psnr for row in later_frames]))},
                "later": float(np.mean([row.num_bytes for row in later_frames])),
                "lzma": float(np.mean([row["lzma"] for row in frames])),
                **times,
            }
        )
    best = rows[-1]["psnr"]["later"]
    return {"name": name, "rows": [{**row, "loss": best - row["psnr"]["later"]} for row in rows]}


def quality_table(clips: Sequence[Row]) -> str:
    """Return quality, bytes and times of a later frame by clip and quality, in Markdown."""
    rows = [{"clip": clip["name"], **row} for clip in clips for row in clip["rows"]]
    keys = {"clip": lambda row: f"`{row['clip']}`", "quality": lambda row: f"{row['quality']:g}"}
    return scores_table(rows, keys, COLUMNS)


def plot_codec(clips: Sequence[Row], path: Path) -> None:
    """Plot quality and encoding time over the bytes of a later frame.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = blank_figure(10, 3.8 * len(clips))
    grid = figure.subplots(len(clips), 2, squeeze=False)
    for (left, right), clip in zip(grid, clips, strict=True):
        rows = clip["rows"]
        for axis, scores in ((left, ("psnr", "psnr")), (right, ("encode_ms", "lzma_ms"))):
            names = zip(("later", "lzma"), scores, ("o-", "s--"), _LABELS, strict=True)
            for size, score, style, label in names:
                x = [1e-3 * row[size] for row in rows]
                y = [row[score]["later"] if score == "psnr" else row[score] for row in rows]
                axis.plot(x, y, style, label=label)
                if size == "later":
                    texts = [f"{row['quality']:g}" for row in rows]
                    label_points(axis, zip(x, y, strict=True), texts, (4, -12), 8)
            axis.set(xscale="log", xlabel="kB per later frame")
            axis.grid(alpha=0.3, which="both")
            axis.tick_params(axis="x", which="minor", labelsize=6, rotation=45)
        left.set(ylabel="PSNR of later frames, dB", title=f"{clip['name']}: quality")
        title = f"{clip['name']}: encoding time"
        right.set(ylabel="ms to encode a frame", yscale="log", title=title)
        left.ticklabel_format(axis="y", useOffset=False)
        left.legend(fontsize=8)
    save_figure(figure, path)


def _frame(
    old_state: CodedFrame, new_state: CodedFrame, cameras: Sequence[Any], settings: StreamConfig
) -> dict[str, Any]:
    """Return times and bytes of one frame, encoded again with the codec and with lzma."""
    source = np.searchsorted(old_state.ids, new_state.ids)
    born = new_state.ids >= old_state.next_id
    source[born] = -1
    start = time.perf_counter()
    residual_packet(old_state, new_state.gaussians, source, cameras, settings.codec)
    encode_end = time.perf_counter()
    survivors = source[~born]
    old = old_state.gaussians.numpy()
    new = new_state.gaussians.numpy()
    raw = b"".join(
        np.concatenate([new[name][~born] - old[name][survivors], new[name][born]]).tobytes()
        for name in new
        if name != "motion"
    )
    lzma_start = time.perf_counter()
    archive = lzma.compress(raw, preset=_LZMA_PRESET)
    return {
        "encode_ms": 1e3 * (encode_end - start),
        "lzma_ms": 1e3 * (time.perf_counter() - lzma_start),
        "lzma": len(archive),
    }
