"""The report on the method for people: tables for documentation, and plots of quality against run time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.method_cells import DEFAULT
from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from morgs_mi.evaluate.tables import figure

__all__ = [
    "ablation_table",
    "aims_table",
    "best_rows",
    "epochs_table",
    "gains_table",
    "key_views_table",
    "method_page",
    "plot_method",
]

Row = Mapping[str, Any]

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
_PANELS = (
    ("PSNR of the held-out view, dB", "psnr", None),
    ("PSNR where things move, dB", "psnr_moving", None),
    ("motion error where things move, px", "motion_error_moving", "cue"),
    ("3D motion error, share of the true length", "motion_3d_relative_error", None),
)
# What is compared: presets with something, and without.
_GAINS = (
    ("motion", "ml", "baseline"),
    ("offset", "ml-mo", "ml"),
    ("confidence", "ml-mo-mc", "ml-mo"),
    ("`paper`, to `baseline`", "paper", "baseline"),
    ("`ml-mo-mc`, to `paper`", "ml-mo-mc", "paper"),
)
# Has all parts, as what is the default has.
_WHOLE = "ml-mo-mc"
_GAINED = ("psnr", "psnr_moving", "motion_error_moving")


def best_rows(clip: Mapping[str, Any]) -> list[Row]:
    """Return each preset's rows at its best rate, by preset and epochs."""
    rows = [row for row in clip["rows"] if row["best"]]
    order = list(dict.fromkeys(row["preset"] for row in rows))
    return sorted(rows, key=lambda row: (order.index(row["preset"]), row["epochs"]))


def ablation_table(clip: Mapping[str, Any], epochs: int) -> str:
    """Return the paper's Table 4 on a clip: one row per preset at so many epochs."""
    rows = [row for row in best_rows(clip) if row["epochs"] == epochs]
    return _table(("preset", "rates"), rows, lambda row: (f"`{row['preset']}`", f"{row['rates']:g}x"))


def epochs_table(clip: Mapping[str, Any]) -> str:
    """Return quality against run time: one row per preset and number of epochs."""
    words = ("preset", "epochs", "rates")
    return _table(words, best_rows(clip), lambda r: (f"`{r['preset']}`", str(r["epochs"]), f"{r['rates']:g}x"))


def key_views_table(clip: Mapping[str, Any]) -> str:
    """Return the paper's Table 5 on a clip: motion without and with offset by key views."""
    titles = {"ml": "without offset", "ml-mo": "with offset"}
    rows = sorted(clip["key_view_rows"], key=lambda row: (row["preset"], row["key_views"]))
    return _table(("", "key views"), rows, lambda row: (titles[row["preset"]], str(row["key_views"])))


def gains_table(clips: Sequence[Mapping[str, Any]]) -> str:
    """Return what parts add at the best rates: PSNR, whole and where things move, in dB, and motion error in px."""
    table = []
    for clip in clips:
        rows = {(row["preset"], row["epochs"]): row["mean"] for row in best_rows(clip)}
        for epochs in sorted({epochs for _, epochs in rows}):
            cells = []
            for _, preset, without in _GAINS:
                gains = [_score(rows, (preset, epochs), n) - _score(rows, (without, epochs), n) for n in _GAINED]
                cells.append(" / ".join(f"{gain:+.2f}" if _known(gain) else "-" for gain in gains))
            table.append((clip["name"], str(epochs), *cells))
    return markdown(("clip", "epochs", *(words for words, *_ in _GAINS)), table, 2)


def aims_table(clips: Sequence[Mapping[str, Any]]) -> str:
    """Return what is asked of the method and what it does, at the presets' best rates; bold where it is reached."""
    columns = [list(_aims(clip)) for clip in clips]
    table = []
    for aims in zip(*columns, strict=True):
        words, low, high, _ = aims[0]
        asked = f"at most {high:g}" if low == -inf else f"at least {low:g}" if high == inf else f"{low:g} to {high:g}"
        cells = (f"**{figure(found, 2)}**" if low <= found <= high else figure(found, 2) for *_, found in aims)
        table.append((words, asked, *cells))
    return markdown(("", "aim", *(clip["name"] for clip in clips)), table, 2)


def method_page(result: Mapping[str, Any]) -> str:
    """Return all tables of all clips in Markdown; docs/experiments/method.md says how to read them."""
    clips, epochs = result["clips"], result["table_epochs"]
    parts = [f"## What the parts add\n\n{gains_table(clips)}", f"## Aims\n\n{aims_table(clips)}"]
    for clip in clips:
        size = f"{clip['views']} views of {clip['width']}x{clip['height']}, {clip['frames']} frames"
        seeds = best_rows(clip)[0]["runs"]
        spread = "one run" if seeds == 1 else f"mean ± standard deviation of {seeds} runs"
        parts.append(f"## {clip['name']}\n\n{size}; {spread}. {_yardsticks(clip)}{_edges(clip)}")
        parts.append(f"### Parts of the method, {epochs} epochs\n\n{ablation_table(clip, epochs)}")
        if clip["key_view_rows"]:
            parts.append(f"### Key views, {epochs} epochs\n\n{key_views_table(clip)}")
        parts.append(f"### Quality against run time\n\n{epochs_table(clip)}")
        if clip["scratch"]:
            parts.append(f"### Frames fitted from scratch\n\n{_scratch_table(clip, epochs)}")
    return "\n".join(parts)


def plot_method(result: Mapping[str, Any], path: str | Path) -> None:
    """Draw quality against run time: a row of panels per clip, a line per preset, its points labelled by epochs.

    Raises:
        ValueError: matplotlib is not installed.
    """
    clips = result["clips"]
    drawing = blank_figure(4.6 * len(_PANELS), 4.0 * len(clips) + 0.6)
    grid = drawing.subplots(len(clips), len(_PANELS), squeeze=False)
    for axes, clip in zip(grid, clips, strict=True):
        rows = best_rows(clip)
        for axis, (title, name, yardstick) in zip(axes, _PANELS, strict=True):
            for preset in dict.fromkeys(row["preset"] for row in rows):
                _draw_line(axis, preset, name, [row for row in rows if row["preset"] == preset])
            if yardstick and clip[yardstick]:
                axis.axhline(clip[yardstick]["error"], color="k", linestyle=":", label="the flow's own error")
            axis.set(title=f"{clip['name']}: {title}", xlabel="seconds per later frame", xscale="log")
            axis.title.set_fontsize(10)
            axis.grid(alpha=0.3, which="both")
            axis.tick_params(axis="x", which="both", labelsize=7)
            for ticks in (axis.xaxis.set_major_formatter, axis.xaxis.set_minor_formatter):
                ticks("{x:g}")
    handles = {label: line for axis in grid.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    drawing.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=8, fontsize=9)
    save_figure(drawing, path)


def _aims(clip: Mapping[str, Any]) -> Iterator[tuple[str, float, float, float]]:
    """Yield each aim: what it is, the lowest and the highest that is asked, and the figure, NaN where unknown."""
    rows = {(row["preset"], row["epochs"]): row["mean"] for row in best_rows(clip)}
    whole = DEFAULT if any(preset == DEFAULT for preset, _ in rows) else _WHOLE

    def score(name: str, epochs: int = 8, preset: str = whole) -> float:
        return _score(rows, (preset, epochs), name)

    def share(name: str) -> float:
        return _share(score(name), score(name, preset="baseline"))

    pictures = (("PSNR", "psnr"), ("PSNR where things move", "psnr_moving"))
    for epochs, asked in ((2, (1.5, 3)), (8, (0.5, 1))):
        for (words, name), low in zip(pictures, asked, strict=True):
            gain = score(name, epochs) - score(name, epochs, "baseline")
            yield f"{words} at {epochs} epochs over `baseline`, dB", low, inf, gain
    for words, name in pictures:
        gain = score(name, 2) - score(name, 8, "paper")
        yield f"{words} at 2 epochs over `paper` at 8, dB", 0, inf, gain
    cue = clip["cue"]["error"] if clip["cue"] else nan
    yield "motion error as a share of the flow's own", -inf, 1.2, _share(score("motion_error_moving"), cue)
    yield "motion error as a share of `baseline`'s", -inf, 0.33, share("motion_error_moving")
    yield "motion error in 3D as a share of `baseline`'s", -inf, 0.33, share("motion_3d_error")
    yield "IoU of confidence", 0.8, inf, score("confidence_iou")
    yield "mTV as a share of `baseline`'s", -inf, 1, share("mtv")
    yield "mTV as a share of the recording's", 0.9, 1.1, _share(score("mtv"), score("mtv_input"))
    yield "slope, dB per frame", -0.01, inf, score("psnr_slope")


def _score(rows: Mapping[tuple[str, int], Mapping[str, Any]], setting: tuple[str, int], name: str) -> float:
    """Return a setting's mean, NaN where it is unknown."""
    value = rows.get(setting, {}).get(name)
    return nan if value is None else value


def _share(part: float, whole: float) -> float:
    return part / whole if whole else nan


def _draw_line(axis: Any, preset: str, name: str, rows: Sequence[Row]) -> None:
    seconds, values = (np.array([row["mean"][key] for row in rows], float) for key in ("seconds", name))
    spread = np.nan_to_num(np.array([row["std"][name] for row in rows], float))
    axis.errorbar(seconds, values, spread, fmt="o-", markersize=4, capsize=2, label=preset, alpha=0.85)
    label_points(axis, zip(seconds, values, strict=True), [str(row["epochs"]) for row in rows], (4, 3))


def _table(words: Sequence[str], rows: Sequence[Row], name: Any) -> str:
    """Return a table of all scores that are known in any of the rows."""
    columns = [column for column in _COLUMNS if any(_known(row["mean"][column[1]]) for row in rows)]
    cells = [(*name(row), *(_spread(row, key, digits, unit) for _, key, digits, unit in columns)) for row in rows]
    return markdown((*words, *(column[0] for column in columns)), cells, len(words))


def _scratch_table(clip: Mapping[str, Any], epochs: int) -> str:
    titles = ("frame", "preset", "steps", "PSNR, dB", "moving")
    rows = []
    for found in clip["scratch"]:
        frame = found["frame"]
        scores = (figure(found[name], 2) for name in ("psnr", "psnr_moving"))
        rows.append((str(frame), "from scratch", str(found["steps"]), *scores))
        for row in best_rows(clip):
            if row["epochs"] == epochs:
                values = (row["by_frame"][name][frame - 1] for name in ("psnr", "psnr_moving"))
                steps = epochs * (clip["views"] - clip["held_out"])
                rows.append((str(frame), f"`{row['preset']}`", str(steps), *(figure(value, 2) for value in values)))
    return markdown(titles, rows, 2)


def _yardsticks(clip: Mapping[str, Any]) -> str:
    mean = next(row["mean"] for row in clip["rows"])
    words = [f"The recording's own mTV is {figure(mean['mtv_input'], 3)}"]
    if clip["cue"]:
        words.append(f"motion is {figure(mean['true_motion_moving'], 1)} px where things move")
        words.append(f"the flow that guides it is off by {figure(clip['cue']['error'], 2)} px there")
    return ", ".join(words) + ".\n"


def _edges(clip: Mapping[str, Any]) -> str:
    """Return a warning about presets whose best rate is the largest that was tried, empty if there are none."""
    tried = {row["preset"]: set() for row in clip["rows"]}
    for row in clip["rows"]:
        tried[row["preset"]].add(row["rates"])
    edges = [
        row for row in best_rows(clip) if len(tried[row["preset"]]) > 1 and row["rates"] == max(tried[row["preset"]])
    ]
    found = ", ".join(f"`{row['preset']}` at {row['epochs']} epochs" for row in edges)
    return f"Larger rates than were tried may be better for {found}.\n" if found else ""


def _spread(row: Row, name: str, digits: int, unit: float) -> str:
    mean, std = (row[part][name] for part in ("mean", "std"))
    if not _known(mean):
        return "-"
    return figure(unit * mean, digits) + (f" ± {figure(unit * std, digits)}" if _known(std) else "")


def _known(value: float | None) -> bool:
    return value is not None and value == value
