"""Tables and plots of the report on the method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from benchmarks.reports.study import Row
from morgs_mi.evaluate.tables import figure

_COLUMNS = (
    ("PSNR, dB", "psnr", 2, 1),
    ("moving", "psnr_moving", 2, 1),
    ("still", "psnr_still", 2, 1),
    ("motion error, px", "motion_error_moving", 2, 1),
    ("still", "motion_error_still", 2, 1),
    ("in 3D, %", "motion_3d_relative_error", 0, 100),
    ("IoU", "confidence_iou", 2, 1),
    ("mTV", "mtv", 3, 1),
    ("slope, dB", "psnr_slope", 3, 1),
    ("kB", "num_bytes", 1, 1e-3),
    ("s", "seconds", 2, 1),
)
# Title, score, whether to draw the error of the flow.
_PANELS = (
    ("PSNR of the held-out view, dB", "psnr", False),
    ("PSNR where things move, dB", "psnr_moving", False),
    ("motion error where things move, px", "motion_error_moving", True),
    ("3D motion error, share of the true length", "motion_3d_relative_error", False),
)
# Compared presets: title, preset with a part, preset without it.
_GAINS = (
    ("motion", "ml", "baseline"),
    ("offset", "ml-mo", "ml"),
    ("confidence", "ml-mo-mc", "ml-mo"),
    ("`paper`, to `baseline`", "paper", "baseline"),
    ("`ml-mo-mc`, to `paper`", "ml-mo-mc", "paper"),
)
_GAINED = ("psnr", "psnr_moving", "motion_error_moving")


def best_rows(clip: Row) -> list[Row]:
    """Return each preset's rows at its best rate, by preset and epochs."""
    rows = [row for row in clip["rows"] if row["best"]]
    order = list(dict.fromkeys(row["preset"] for row in rows))
    return sorted(rows, key=lambda row: (order.index(row["preset"]), row["epochs"]))


def ablation_table(clip: Row, epochs: int) -> str:
    """Return the paper's Table 4 on a clip: one row per preset at a number of epochs."""
    rows = [row for row in best_rows(clip) if row["epochs"] == epochs]
    return _table(
        ("preset", "rates"), rows, lambda row: (f"`{row['preset']}`", f"{row['rates']:g}x")
    )


def key_views_rows(clip: Row) -> list[Row]:
    """Return the rows that compare numbers of key views, by preset and number."""
    return sorted(clip["key_view_rows"], key=lambda row: (row["preset"], row["key_views"]))


def key_views_table(clip: Row) -> str:
    """Return the paper's Table 5 on a clip: motion without and with offset by key views."""
    titles = {"ml": "without offset", "ml-mo": "with offset"}
    return _table(
        ("", "key views"),
        key_views_rows(clip),
        lambda row: (titles[row["preset"]], str(row["key_views"])),
    )


def gains_table(clips: Sequence[Row]) -> str:
    """Return the gains of the parts at the best rates: PSNR of whole and moving region, dB, and
    motion error, px.
    """
    table = []
    for clip in clips:
        rows = {(row["preset"], row["epochs"]): row["mean"] for row in best_rows(clip)}
        for epochs in sorted({epochs for _, epochs in rows}):
            cells = []
            for _, preset, without in _GAINS:
                gains = [
                    _score(rows, (preset, epochs), n) - _score(rows, (without, epochs), n)
                    for n in _GAINED
                ]
                cells.append(" / ".join(f"{gain:+.2f}" if _known(gain) else "-" for gain in gains))
            table.append((clip["name"], str(epochs), *cells))
    return markdown(("clip", "epochs", *(title for title, *_ in _GAINS)), table, 2)


def plot_method(clips: Sequence[Row], path: Path) -> None:
    """Plot quality over run time: a row of panels per clip, a line per preset, points labelled by
    epochs.

    Raises:
        ValueError: matplotlib is not installed.
    """
    drawing = blank_figure(4.6 * len(_PANELS), 4.0 * len(clips) + 0.6)
    grid = drawing.subplots(len(clips), len(_PANELS), squeeze=False)
    for axes, clip in zip(grid, clips, strict=True):
        rows = best_rows(clip)
        for axis, (title, name, with_flow) in zip(axes, _PANELS, strict=True):
            for preset in dict.fromkeys(row["preset"] for row in rows):
                _draw_line(axis, preset, name, [row for row in rows if row["preset"] == preset])
            if with_flow and clip["cue"] is not None:
                axis.axhline(
                    clip["cue"]["error"], color="k", linestyle=":", label="error of the flow"
                )
            axis.set(
                title=f"{clip['name']}: {title}", xlabel="seconds per later frame", xscale="log"
            )
            axis.title.set_fontsize(10)
            axis.grid(alpha=0.3, which="both")
            axis.tick_params(axis="x", which="both", labelsize=7)
            for ticks in (axis.xaxis.set_major_formatter, axis.xaxis.set_minor_formatter):
                ticks("{x:g}")
    handles = {
        label: line
        for axis in grid.flat
        for line, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    drawing.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=8, fontsize=9
    )
    save_figure(drawing, path)


def _score(
    rows: Mapping[tuple[str, int], Mapping[str, float]], setting: tuple[str, int], name: str
) -> float:
    """Return a setting's mean, NaN if it is unknown."""
    value = rows.get(setting, {}).get(name)
    return nan if value is None else value


def _draw_line(axis: Any, preset: str, name: str, rows: Sequence[Row]) -> None:
    seconds, values = (
        np.array([row["mean"][key] for row in rows], float) for key in ("seconds", name)
    )
    spread = np.nan_to_num(np.array([row["std"][name] for row in rows], float))
    axis.errorbar(
        seconds, values, spread, fmt="o-", markersize=4, capsize=2, label=preset, alpha=0.85
    )
    label_points(
        axis, zip(seconds, values, strict=True), [str(row["epochs"]) for row in rows], (4, 3)
    )


def _table(titles: Sequence[str], rows: Sequence[Row], name: Any) -> str:
    """Return a table of all scores that are known in any of the rows."""
    columns = [column for column in _COLUMNS if any(_known(row["mean"][column[1]]) for row in rows)]
    cells = [
        (*name(row), *(_spread(row, key, digits, unit) for _, key, digits, unit in columns))
        for row in rows
    ]
    return markdown((*titles, *(column[0] for column in columns)), cells, len(titles))


def _spread(row: Row, name: str, digits: int, unit: float) -> str:
    mean = row["mean"][name]
    std = row["std"][name]
    if not _known(mean):
        return "-"
    deviation = f" ± {figure(unit * std, digits)}" if _known(std) else ""
    return figure(unit * mean, digits) + deviation


def _known(value: float | None) -> bool:
    return value is not None and value == value
