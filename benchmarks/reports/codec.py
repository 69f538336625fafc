"""Bytes, quality and time of the codec at several quality settings, compared with lzma over raw residuals.

Each setting fits the clip again, because the next frame starts from what the codec has quantised. Fits of one setting
differ by some hundredths of a dB; smaller differences are not significant.
"""

from __future__ import annotations

import asyncio
import lzma
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from benchmarks.reports.records import Record
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.executor import Workers, wait_for
from morgs_mi.cluster.segments import fit_in_segments
from morgs_mi.codec.entropy import column_bits
from morgs_mi.codec.packets import CodedFrame, coded_frames, decode, residual_packet
from morgs_mi.codec.quantisation import step_sizes
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.playback.player import open_stream
from morgs_mi.recorder import stream_capture

__all__ = [
    "CodecClip",
    "CodecQuality",
    "CodecReportConfig",
    "CodecResult",
    "CodecRow",
    "markdown_table",
    "plot_codec",
    "report_codec",
]

# The best preset of lzma takes several times as long and saves a few percent.
_LZMA_PRESET = 6


@dataclass(frozen=True)
class CodecReportConfig:
    """Settings of the report on the codec."""

    qualities: tuple[float, ...] = (0.5, 1, 2, 4)
    """Values of `codec.quality`."""
    reference: float = 1000
    """Quality of the stream that serves as the uncompressed reference."""
    frames: int | None = None
    """Maximum number of frames from the start."""
    stream: StreamConfig = field(default_factory=StreamConfig)
    """Settings of the fit."""
    resume: bool = False
    """Reuse streams of an earlier report with the same settings, and continue incomplete ones."""

    def __post_init__(self) -> None:
        if not self.qualities or not all(0 < quality < self.reference for quality in self.qualities):
            raise ValueError(
                f"CodecReportConfig(): `qualities` must be positive and below the reference's {self.reference:g}, got "
                f"{list(self.qualities)}."
            )


@dataclass(frozen=True)
class CodecQuality:
    """PSNR of a stream, dB."""

    first: float
    """PSNR of the first frame."""
    later: float
    """Mean PSNR of the later frames."""


@dataclass(frozen=True)
class CodecRow:
    """Quality, bytes and times of one stream; times are medians over the later frames.

    `raw` and `lzma` measure float32 residuals between the decoded frames, without and with lzma. They lead to the same
    frames, so lzma benefits from values that were rounded to zero; in the reference stream there are none.
    """

    quality: float
    """Value of `codec.quality`."""
    psnr: CodecQuality
    file: int
    """Size of the file, bytes."""
    first: int
    """Size of the first frame, bytes."""
    later: float
    """Mean size of a later frame, bytes."""
    raw: float
    """Mean size of a later frame's float32 residual, bytes."""
    lzma: float
    """Mean size of a later frame's float32 residual with lzma, bytes."""
    moved: float
    """Mean number of Gaussians that a later frame writes."""
    encode_ms: float
    decode_ms: float
    lzma_ms: float
    bytes_by_group: Mapping[str, float]
    """Mean entropy of a later frame by group of attributes, bytes."""
    loss: float
    """PSNR of the reference's later frames minus that of this stream, dB."""


@dataclass(frozen=True)
class CodecClip:
    """Results of one clip."""

    name: str
    rows: tuple[CodecRow, ...]
    """One row per quality; the reference is last."""


@dataclass(frozen=True)
class CodecResult(Record):
    """Results of the report on the codec."""

    clips: tuple[CodecClip, ...]
    settings: Mapping[str, Any]
    machine: Mapping[str, Any]
    versions: Mapping[str, str]


def report_codec(
    captures: Sequence[str | Path],
    out: str | Path,
    config: CodecReportConfig,
    progress: Callable[[str, float, float], None] = lambda stage, done, total: None,
    workers: Workers | None = None,
) -> CodecResult:
    """Fit every capture with every quality and measure the streams, which stay in OUT/CLIP/QUALITY.

    Args:
        captures: folders of captures; those without a held-out view are evaluated in the training views.
        out: folder for the streams.
        config: settings.
        progress: called with (stage, done, total).
        workers: from `open_workers`, which fit the qualities of a clip side by side; None: this process fits them, one
            by one. It measures the streams in any case.

    Returns:
        One clip per capture, the settings, the machine and the versions.

    Raises:
        ValueError: there is no capture, a capture has a single frame, or as `stream_capture` and `evaluate_stream`.
    """
    if not captures:
        raise ValueError("report_codec(): `captures` must name at least one folder, got none.")
    recordings = (load_capture(path, max_frames=config.frames) for path in captures)
    clips = tuple(_clip(recording, Path(out), config, progress, workers) for recording in recordings)
    return CodecResult(clips, asdict(config), machine(), versions())


def markdown_table(clip: CodecClip) -> str:
    """Return one clip's rows as a table."""
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
    for row in clip.rows:
        cells = [f"{row.quality:g}", f"{row.psnr.later:.2f}", f"{row.loss:.2f}", _kilo(row.first)]
        cells += [_kilo(row.later), _kilo(row.lzma), f"{row.moved:.0f}"]
        cells += [f"{ms:.0f}" for ms in (row.encode_ms, row.decode_ms, row.lzma_ms)]
        rows.append(cells)
    return markdown(titles, rows, left=0)


def plot_codec(result: CodecResult, path: str | Path) -> None:
    """Plot quality and encoding time over the bytes of a later frame.

    Raises:
        ValueError: matplotlib is not installed.
    """
    clips = result.clips
    figure = blank_figure(10, 3.8 * len(clips))
    for (left, right), clip in zip(figure.subplots(len(clips), 2, squeeze=False), clips, strict=True):
        rows = clip.rows
        later, packed = (1e-3 * np.array(column) for column in zip(*((r.later, r.lzma) for r in rows), strict=True))
        psnr = [row.psnr.later for row in rows]
        times = [row.encode_ms for row in rows], [row.lzma_ms for row in rows]
        for axis, (own, other) in ((left, (psnr, psnr)), (right, times)):
            axis.plot(later, own, "o-", label="stream")
            axis.plot(packed, other, "s--", label="lzma over float32 residuals")
            axis.set(xscale="log", xlabel="kB per later frame")
            axis.grid(alpha=0.3, which="both")
            axis.tick_params(axis="x", which="minor", labelsize=6, rotation=45)
            points = zip(later, own, strict=True)
            label_points(axis, points, [f"{row.quality:g}" for row in rows], (4, -12), 8)
        left.set(ylabel="PSNR of later frames, dB", title=f"{clip.name}: quality")
        right.set(ylabel="ms to encode a frame", yscale="log", title=f"{clip.name}: encoding time")
        left.ticklabel_format(axis="y", useOffset=False)
        left.legend(fontsize=8)
    save_figure(figure, path)


def _clip(
    capture: Capture,
    out: Path,
    config: CodecReportConfig,
    progress: Callable[[str, float, float], None],
    workers: Workers | None,
) -> CodecClip:
    name = capture.path.resolve().name
    if capture.num_frames < 2:
        raise ValueError(f"{capture.path}: expected a capture of two frames or more, got {capture.num_frames}.")
    qualities, rows = (*config.qualities, config.reference), []
    fits = {
        out / name / f"{quality:g}": replace(config.stream, codec=replace(config.stream.codec, quality=quality))
        for quality in qualities
    }
    if workers is not None:
        progress(f"Fitting {name}", 0, len(qualities))
        wait_for(_fit_all(capture, fits, workers, config.resume))
    for done, (quality, (folder, settings)) in enumerate(zip(qualities, fits.items(), strict=True)):
        progress(f"Fitting {name}", done, len(qualities))
        stream_capture(capture, folder, settings, resume=config.resume or workers is not None)
        rows.append({"quality": quality, **_evaluated(folder, capture), **_measured(folder, settings)})
    progress(f"Fitting {name}", len(qualities), len(qualities))
    best = rows[-1]["psnr"].later
    return CodecClip(name, tuple(CodecRow(**row, loss=best - row["psnr"].later) for row in rows))


async def _fit_all(capture: Capture, fits: Mapping[Path, StreamConfig], workers: Workers, resume: bool) -> None:
    """Fit a capture into several folders, side by side."""
    fit = (fit_in_segments(capture, folder, workers, config, resume=resume) for folder, config in fits.items())
    await asyncio.gather(*fit)


def _evaluated(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the quality and the bytes of the decoded stream."""
    found = evaluate_stream(folder, capture.path)
    first, *later = found.frames
    return {
        "psnr": CodecQuality(first.scores.psnr, float(np.mean([row.scores.psnr for row in later]))),
        "file": found.sizes.file,
        "first": first.num_bytes,
        "later": float(np.mean([row.num_bytes for row in later])),
    }


def _measured(folder: Path, settings: StreamConfig) -> dict[str, Any]:
    """Return times and bytes of encoding the later frames again, with the codec and with lzma."""
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
    """Return times and bytes of one frame, encoded again with the codec and with lzma."""
    source = np.searchsorted(before.ids, now.ids)
    born = now.ids >= before.next_id
    source[born] = -1
    start = time.perf_counter()
    packet = residual_packet(before, now.gaussians, source, cameras, settings.codec)
    encoded = time.perf_counter()
    decode(before, packet)
    decoded = time.perf_counter()
    survivors = source[~born]
    change = now.grid.values[~born].astype(np.int64) - before.grid.values[survivors]
    wrote = (change != 0).any(1)
    old, new = before.gaussians.numpy(), now.gaussians.numpy()
    raw = b"".join(
        np.concatenate([new[name][~born] - old[name][survivors], new[name][born]]).tobytes()
        for name in new
        if name != "motion"
    )
    started = time.perf_counter()
    packed = lzma.compress(raw, preset=_LZMA_PRESET)
    written = np.rint(change / step_sizes(packet.arrays["head"][1].astype(int))).astype(np.int64)
    groups = {name: _bytes(*written[written[:, at].any(1), at].T) for name, at in now.grid.columns.items()}
    return {
        "encode_ms": 1e3 * (encoded - start),
        "decode_ms": 1e3 * (decoded - encoded),
        "lzma_ms": 1e3 * (time.perf_counter() - started),
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
