"""Plot of the check of a whole recording: one panel per question."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np

from morgs_mi.calibration.checks.deep import DeepCheck

__all__ = ["draw_deep"]

_USUAL, _FOUND, _CHANNELS = "tab:blue", "tab:red", ("indianred", "seagreen", "royalblue")
_BAR = 0.7  # width of a bar or of a group of them, as a share of its slot
_MAX_LINES, _LINE = 16, 140  # of the findings, and characters of each
# Title, and the least range of the vertical axis: negligible differences look small.
_PANELS: dict[str, tuple[str, tuple[float, float] | None]] = {
    "error": ("Reprojection error, px", (0, 1)),
    "time": ("Time offset, frames", (-1, 1)),
    "exposure": ("Exposure of R, G, B, %", (-10, 10)),
    "brightness": ("Brightness over time, %", (-5, 5)),
    "sharpness": ("Sharpness over time, octaves", (-1, 1)),
    "repeats": ("Repeated frames (red) and missing ones (grey)", None),
    "overlap": ("Share of the row's image in the column's, %", None),
    "findings": ("Findings: {count}", None),
}


def draw_deep(figure: Any, check: DeepCheck) -> None:
    """Plot a check: a panel per question, and the findings.

    The panels show reprojection error, time offset, exposure per channel, brightness and sharpness over time, repeated
    frames and overlap. Cameras with a finding are red; a question mark stands for a missing measurement.

    Args:
        figure: an empty figure or subfigure of matplotlib.
        check: result of `check_deep`.
    """
    names = [
        ["error", "time", "exposure"],
        ["brightness", "sharpness", "repeats"],
        ["overlap", "findings", "findings"],
    ]
    panels = figure.subplot_mosaic(names)
    _bars(panels["error"], check, "error", check.errors[:, None])
    _bars(panels["time"], check, "time", check.offsets[:, None])
    _bars(panels["exposure"], check, "exposure", 100 * np.expm1(check.gains))
    _curves(panels["brightness"], check, ("variation", "flicker"), 100 * np.expm1(check.brightness))
    _curves(panels["sharpness"], check, ("blur",), check.sharpness)
    _events(panels["repeats"], check)
    _matrix(panels["overlap"], check)
    _sentences(panels["findings"], check)
    for name, panel in panels.items():
        title, least = _PANELS[name]
        panel.set_title(title.format(count=len(check.findings)), fontsize=11, loc="left")
        if least is not None:
            low, high = panel.get_ylim()
            panel.set_ylim(min(low, least[0]), max(high, least[1]))


def _bars(panel: Any, check: DeepCheck, question: str, values: np.ndarray) -> None:
    """Draw a group of bars per camera, for values [C, K]."""
    views, count = range(len(values)), values.shape[1]
    for k, column in enumerate(values.T):
        places = np.array(views) + _BAR * ((k + 0.5) / count - 0.5)
        colors = [_CHANNELS[k] if count > 1 else _color(check, (question,), view) for view in views]
        panel.bar(places, np.nan_to_num(column), _BAR / count, color=colors)
        for place in places[~np.isfinite(column)]:
            panel.annotate("?", (place, 0), ha="center", va="bottom", color="0.5")
    panel.axhline(0, color="black", linewidth=0.8)
    _name_cameras(panel.xaxis, check, (question,), rotation=90 if len(values) > 8 else 0)


def _curves(panel: Any, check: DeepCheck, questions: Sequence[str], values: np.ndarray) -> None:
    """Draw a curve per camera, for values [T, C]; cameras with a finding are drawn last, with their names."""
    for view, curve in enumerate(values.T):
        found = _is_found(check, questions, view)
        panel.plot(curve, color=_color(check, questions, view), linewidth=1, zorder=3 if found else 2)
        known = np.flatnonzero(np.isfinite(curve))
        if found and len(known):
            panel.annotate(check.names[view], (known[-1], curve[known[-1]]), ha="right", va="bottom", color=_FOUND)
    if not np.isfinite(values).any():
        panel.annotate("not measured", (0.5, 0.5), xycoords="axes fraction", ha="center", color="0.5")
    panel.set(xlim=(-0.5, check.frames - 0.5), xlabel="frame")
    panel.xaxis.get_major_locator().set_params(integer=True)


def _events(panel: Any, check: DeepCheck) -> None:
    """Draw a row per camera with the frames that repeat another or are missing."""
    for view, repeated in enumerate(check.repeated):
        missing = np.flatnonzero(np.isnan(check.sharpness[:, view]))
        for frames, color in ((missing, "0.75"), (repeated, _FOUND)):
            panel.broken_barh([(frame - 0.5, 1) for frame in frames], (view - 0.45, 0.9), color=color)
    panel.set(xlim=(-0.5, check.frames - 0.5), ylim=(len(check.names) - 0.5, -0.5), xlabel="frame")
    panel.xaxis.get_major_locator().set_params(integer=True)
    _name_cameras(panel.yaxis, check, ("repeats",))


def _matrix(panel: Any, check: DeepCheck) -> None:
    """Draw the share of each row's image that each column's camera sees."""
    shares = np.where(np.eye(len(check.names), dtype=bool), np.nan, 100 * check.overlaps)
    panel.imshow(shares, cmap="Blues", vmin=0, vmax=100)
    panel.set_anchor("W")
    if len(shares) <= 8:
        for (row, column), share in np.ndenumerate(shares):
            if np.isfinite(share):
                color = "white" if share > 60 else "black"
                panel.annotate(f"{share:.0f}", (column, row), ha="center", va="center", fontsize=7, color=color)
    panel.set_xticks([])
    _name_cameras(panel.yaxis, check, ("overlap",))


def _sentences(panel: Any, check: DeepCheck) -> None:
    """Write the findings and the missing measurements."""
    sentences = [*(finding.sentence for finding in check.findings), check.unmeasured]
    lines = "\n".join(fill(sentence, _LINE, subsequent_indent="  ") for sentence in sentences).splitlines()
    lines = lines if len(lines) <= _MAX_LINES else [*lines[: _MAX_LINES - 1], "..."]
    panel.set_axis_off()
    text = panel.text(0, 1, "\n".join(lines), va="top", fontsize=8, transform=panel.transAxes)
    text.set_in_layout(False)  # it would shrink the other panels


def _name_cameras(axis: Any, check: DeepCheck, questions: Sequence[str], rotation: float = 0) -> None:
    """Label the positions along an axis with the cameras' names, red with a finding."""
    axis.set_ticks(np.arange(len(check.names)), check.names, fontsize=8, rotation=rotation)
    for view, label in enumerate(axis.get_ticklabels()):
        label.set_color(_FOUND if _is_found(check, questions, view) else "black")


def _is_found(check: DeepCheck, questions: Sequence[str], view: int) -> bool:
    return any(f.question in questions and check.names[view] in f.cameras for f in check.findings)


def _color(check: DeepCheck, questions: Sequence[str], view: int) -> str:
    return _FOUND if _is_found(check, questions, view) else _USUAL
