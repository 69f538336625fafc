"""An `Evaluation` as tables of at most 80 columns and as sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from morgs_mi.evaluate.measures import REGIONS
from morgs_mi.evaluate.results import Evaluation, ViewScores
from morgs_mi.platform.checks import few

# Title, name of the score and decimals. Some scores are of the whole image alone.
_METRICS = (
    ("PSNR, dB", "psnr", 2),
    ("PSNR, colours matched", "psnr_matched", 2),
    ("PSNR, nearest image copied", "psnr_nearest", 2),
    ("PSNR of the light, mu-law", "psnr_mu", 2),
    ("SSIM", "ssim", 4),
    ("dE2000", "delta_e", 2),
    ("LPIPS", "lpips", 4),
    ("flow error, px", "motion_error", 2),
)
_FRAME = (
    ("PSNR, dB", "psnr", 2),
    ("moving", "psnr_moving", 2),
    ("SSIM", "ssim", 4),
    ("flow error", "motion_error", 2),
    ("moving", "motion_error_moving", 2),
)
_VIEW = (
    ("PSNR, dB", "psnr", 2),
    ("colours matched", "psnr_matched", 2),
    ("nearest image", "psnr_nearest", 2),
    ("SSIM", "ssim", 4),
    ("flow error", "motion_error", 2),
)


def figure(value: float | None, digits: int) -> str:
    """Return a number with `digits` decimals, "-" if it is None or NaN."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def evaluation_tables(result: Evaluation) -> Iterator[Table]:
    """Yield tables of the frames, of several views and of the regions."""
    kind = "held-out" if result.held_out else "training"
    table = _table("frame by frame", "frame", *(title for title, *_ in _FRAME), "kB", "s")
    for row in result.frames:
        costs = (figure(row.num_bytes / 1e3, 1), figure(row.seconds, 1))
        table.add_row(str(row.frame), *_cells(row.scores, _FRAME), *costs)
    yield table
    if len(result.views) > 1:
        # A score that the mean of all views lacks, no view has.
        columns = [row for row in _VIEW if not np.isnan(getattr(result.scores, row[1]))]
        title = f"{kind} views, means over the frames"
        table = _table(title, "", *(title for title, *_ in columns))
        for name, scores in {**result.views, "mean": result.scores}.items():
            table.add_row(name, *_cells(scores, columns))
        yield table
    names = few(list(result.views), 2)
    title = f"{kind}: {names}; means, regions from {result.regions}"
    table = _table(title, "", "whole", "moving", "still")
    mean = result.scores
    for title, name, digits in _METRICS:
        cells = [figure(getattr(mean, name + region, None), digits) for region in REGIONS]
        if {*cells} != {"-"}:
            table.add_row(title, *cells)
    if result.variation.render == result.variation.render:
        table.add_row("mTV x100", "", "", figure(result.variation.render, 3))
        table.add_row("mTV x100 of the recording", "", "", figure(result.variation.input, 3))
    yield table


def evaluation_summary(result: Evaluation) -> Iterator[str]:
    """Yield sentences on time, size, drift, 3D motion and, last, views that were not fitted."""
    first = figure(result.frames[0].scores.psnr, 2)
    last = figure(result.frames[-1].scores.psnr, 2)
    yield (
        f"Drift: PSNR {first} dB in the first frame, {last} dB in the last, "
        f"{figure(result.psnr_slope, 4)} dB per frame."
    )
    if result.held_out:
        yield (
            "Held-out in all frames: "
            f"{figure(result.scores.psnr, 2)} dB as recorded, "
            f"{figure(result.scores.psnr_matched, 2)} dB after the gain and bias per channel that "
            "fit best."
        )
    motion = result.motion_3d
    if motion.num_gaussians > 0:
        yield (
            f"3D motion of {motion.num_gaussians:.0f} Gaussians on moving objects: error "
            f"{motion.error:.4f} of {motion.true_length:.4f} units "
            f"({100 * motion.relative_error:.0f} %), angle {motion.angle:.1f} degrees, length "
            f"ratio {motion.length_ratio:.2f}."
        )
    if (iou := result.scores.confidence_iou) == iou:
        yield f"Confidence over the true mask: IoU {iou:.2f}."
    sizes = result.sizes
    yield (
        f"Size: {sizes.file / 1e6:.2f} MB, {figure(sizes.per_keyframe / 1e3, 1)} kB per keyframe, "
        f"{figure(sizes.per_residual / 1e3, 1)} kB per residual."
    )
    seconds = result.seconds
    play = result.playback
    yield (
        f"Time: {figure(seconds.first, 1)} s for the first frame, "
        f"{figure(seconds.per_later_frame, 1)} s per later one, from images to packet; played at "
        f"{figure(play.fps, 0)} frames per second ({figure(play.decode_ms, 1)} ms to decode, "
        f"{figure(play.render_ms, 1)} ms to render)."
    )
    if not result.held_out:
        names = tuple(result.views)
        yield (
            f"These views were fitted; between the cameras: {result.between_cameras}; refit with "
            f"`--hold-out {names[len(names) // 2]}` to measure."
            if result.between_cameras
            else "These views were fitted."
        )


def _cells(scores: ViewScores, columns: Sequence[tuple[str, str, int]]) -> list[str]:
    """Return the scores of a row, given title, name and decimals of each column."""
    return [figure(getattr(scores, name), digits) for _, name, digits in columns]


def _table(title: str, first: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column(first, justify="right" if first else "left", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", min_width=max(map(len, column.split())))
    return table
