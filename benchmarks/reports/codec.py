"""The codec's knob measured: bytes per frame against quality against time, beside lzma over raw residuals.

Each setting fits the clip anew, for what the codec drops the next frame has to live with. Fits of one setting differ by
some hundredths of a dB, so a difference below that says nothing.
"""

from __future__ import annotations

import lzma
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.entropy import column_bits
from morgs_mi.codec.packets import CodedFrame, coded_frames, decode, residual_packet
from morgs_mi.codec.quantisation import step_sizes
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.playback.player import open_stream
from morgs_mi.recorder import stream_capture

__all__ = ["CodecReportConfig", "markdown_table", "plot_codec", "report_codec"]

# The best that lzma has takes several times as long for some percent.
_LZMA_PRESET = 6


@dataclass(frozen=True)
class CodecReportConfig:
    """Which settings are fitted, and how."""

    qualities: tuple[float, ...] = (0.5, 1, 2, 4)
    """Values of `codec.quality`."""
    reference: float = 1000
    """Quality of the stream that stands for the uncompressed one."""
    frames: int | None = None
    """Use at most this many frames from the start."""
    stream: StreamConfig = field(default_factory=StreamConfig)
    """The fit."""
    resume: bool = False
    """Keep the streams that a report with the same settings has left, and go on with one that is not whole."""

    def __post_init__(self) -> None:
        if not self.qualities or not all(0 < quality < self.reference for quality in self.qualities):
            raise ValueError(
                f"CodecReportConfig(): `qualities` must be positive and below the reference's {self.reference:g}, got "
                f"{list(self.qualities)}."
            )


def report_codec(
    captures: Sequence[str | Path],
    out: str | Path,
    config: CodecReportConfig,
    progress: Callable[[str, float, float], None] = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Fit every capture with every quality and return what it costs; the streams stay in OUT/CLIP/QUALITY.

    Args:
        captures: folders of captures; those without a held-out view are judged in the training views.
        out: folder for the streams.
        config: which settings.
        progress: called with (stage, done, total).

    Returns:
        `clips`, one per capture: its `name` and `rows`, one per quality with the reference last: `psnr` of the first
        frame and mean of the later ones, `loss` against the reference's later frames in dB, `file` and `first` in
        bytes, `later` mean bytes of a later frame, `encode_ms` and `decode_ms` (medians over later frames), `moved`
        (mean number of Gaussians that a later frame writes), `bytes_by_group` (of a later frame, by entropy), and
        `lzma` and `raw`: mean bytes of a later frame's float32 residuals with lzma, in `lzma_ms`, and without. They
        lead to the very same states, so lzma, too, profits from what was rounded to zero; not so in the reference.

    Raises:
        ValueError: no captures, one with a single frame, or as `stream_capture` and `evaluate_stream`.
    """
    if not captures:
        raise ValueError("report_codec(): `captures` must name at least one folder, got none.")
    clips = [_clip(load_capture(path, max_frames=config.frames), Path(out), config, progress) for path in captures]
    return {"clips": clips, "settings": asdict(config), "machine": machine(), "versions": versions()}


def markdown_table(clip: Mapping[str, Any]) -> str:
    """Return one clip's rows as a table for documentation."""
    titles = (
        "quality",
        "dB later",
        "loss",
        "kB first",
        "kB later",
        "lzma",
        "moved",
        "encode ms",
        "decode ms",
        "lzma ms",
    )
    rows = []
    for row in clip["rows"]:
        cells = [f"{row['quality']:g}", f"{row['psnr']['later']:.2f}", f"{row['loss']:.2f}", _kilo(row["first"])]
        cells += [_kilo(row["later"]), _kilo(row["lzma"]), f"{row['moved']:.0f}"]
        cells += [f"{row[name]:.0f}" for name in ("encode_ms", "decode_ms", "lzma_ms")]
        rows.append(cells)
    return markdown(titles, rows, left=0)


def plot_codec(result: Mapping[str, Any], path: str | Path) -> None:
    """Draw bytes of a later frame against quality, and against the time to encode it.

    Raises:
        ValueError: matplotlib is not installed.
    """
    clips = result["clips"]
    figure = blank_figure(10, 3.8 * len(clips))
    for (left, right), clip in zip(figure.subplots(len(clips), 2, squeeze=False), clips, strict=True):
        rows = clip["rows"]
        quality, later, loss = ([row[name] for row in rows] for name in ("quality", "later", "psnr"))
        packed = [row["lzma"] for row in rows]
        for axis, values in ((left, [score["later"] for score in loss]), (right, None)):
            own = [row["encode_ms"] for row in rows] if values is None else values
            other = [row["lzma_ms"] for row in rows] if values is None else values
            axis.plot(np.array(later) / 1e3, own, "o-", label="stream")
            axis.plot(np.array(packed) / 1e3, other, "s--", label="lzma over float32 residuals")
            axis.set(xscale="log", xlabel="kB per later frame")
            axis.grid(alpha=0.3, which="both")
            axis.tick_params(axis="x", which="minor", labelsize=6, rotation=45)
            points = zip(np.array(later) / 1e3, own, strict=True)
            label_points(axis, points, [f"{value:g}" for value in quality], (4, -12), 8)
        left.set(ylabel="PSNR of later frames, dB", title=f"{clip['name']}: quality at each byte rate")
        right.set(ylabel="ms to encode a frame", yscale="log", title="and the time it takes")
        left.ticklabel_format(axis="y", useOffset=False)
        left.legend(fontsize=8)
    save_figure(figure, path)


def _clip(
    capture: Capture, out: Path, config: CodecReportConfig, progress: Callable[[str, float, float], None]
) -> dict[str, Any]:
    name = capture.path.resolve().name
    if capture.num_frames < 2:
        raise ValueError(f"{capture.path}: expected a capture of two frames or more, got {capture.num_frames}.")
    qualities, rows = (*config.qualities, config.reference), []
    for done, quality in enumerate(qualities):
        progress(f"Fitting {name}", done, len(qualities))
        folder = out / name / f"{quality:g}"
        settings = replace(config.stream, codec=replace(config.stream.codec, quality=quality))
        stream_capture(capture, folder, settings, resume=config.resume)
        rows.append({"quality": quality, **_judged(folder, capture), **_measured(folder, settings)})
    progress(f"Fitting {name}", len(qualities), len(qualities))
    best = rows[-1]["psnr"]["later"]
    return {"name": name, "rows": [{**row, "loss": best - row["psnr"]["later"]} for row in rows]}


def _judged(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the quality of a stream and its bytes, as a receiver of the file finds them."""
    found = evaluate_stream(folder, capture.path)
    frames = found["frames"]
    later = float(np.mean([row["psnr"] for row in frames[1:]]))
    return {
        "psnr": {"first": frames[0]["psnr"], "later": later},
        "file": found["bytes"]["file"],
        "first": frames[0]["num_bytes"],
        "later": float(np.mean([row["num_bytes"] for row in frames[1:]])),
    }


def _measured(folder: Path, settings: StreamConfig) -> dict[str, Any]:
    """Encode and decode the later frames of a stream once more, and pack their residuals with lzma."""
    stream = open_stream(folder)
    cameras, rows, before = stream.cameras, [], None
    for state in coded_frames(stream):
        if before is not None:
            rows.append(_frame(before, state, cameras, settings))
        before = state
    means = {name: float(np.mean([row[name] for row in rows])) for name in ("raw", "lzma", "moved")}
    medians = {name: float(np.median([row[name] for row in rows])) for name in ("encode_ms", "decode_ms", "lzma_ms")}
    groups = rows[0]["bytes_by_group"]
    return {
        **means,
        **medians,
        "bytes_by_group": {name: float(np.mean([row["bytes_by_group"][name] for row in rows])) for name in groups},
    }


def _frame(before: CodedFrame, now: CodedFrame, cameras: Sequence[Any], settings: StreamConfig) -> dict[str, Any]:
    source = np.searchsorted(before.ids, now.ids)
    born = now.ids >= before.next_id
    source[born] = -1
    start = time.perf_counter()
    packet = residual_packet(before, now.gaussians, source, cameras, settings.codec)
    encoded = time.perf_counter()
    decode(before, packet)
    decoded = time.perf_counter()
    kept = source[~born]
    change = now.grid.values[~born].astype(np.int64) - before.grid.values[kept]
    wrote = (change != 0).any(1)
    old, new = before.gaussians.numpy(), now.gaussians.numpy()
    raw = b"".join(
        np.concatenate([new[name][~born] - old[name][kept], new[name][born]]).tobytes()
        for name in new
        if name != "motion"
    )
    begun = time.perf_counter()
    packed = lzma.compress(raw, preset=_LZMA_PRESET)
    written = np.rint(change / step_sizes(packet.arrays["head"][1].astype(int))).astype(np.int64)
    groups = {name: _bytes(*written[written[:, at].any(1), at].T) for name, at in now.grid.columns.items()}
    return {
        "encode_ms": 1e3 * (encoded - start),
        "decode_ms": 1e3 * (decoded - encoded),
        "lzma_ms": 1e3 * (time.perf_counter() - begun),
        "raw": len(raw),
        "lzma": len(packed),
        "moved": int(wrote.sum()),
        "bytes_by_group": {**groups, "births": _birth_bytes(now, born) if born.any() else 0.0},
    }


def _birth_bytes(state: CodedFrame, born: np.ndarray) -> float:
    new = state.grid.select(np.flatnonzero(born))
    columns = np.concatenate([new.largest_components[:, None], new.exponents, new.values], axis=1, dtype=np.int64)
    return _bytes(*(columns - np.median(columns, axis=0).astype(np.int64)).T)


def _bytes(*columns: np.ndarray) -> float:
    return sum(map(column_bits, columns)) / 8


def _kilo(count: float) -> str:
    return f"{count / 1e3:.1f}"
