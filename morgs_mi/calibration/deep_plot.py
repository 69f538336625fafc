"""Plot of the check of a whole recording: one panel per question."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from morgs_mi.calibration.deep import DeepCheck

__all__ = ["draw_deep"]

_WIDTH, _HEIGHT, _HEAD, _LEFT, _RIGHT, _FOOT = 480, 300, 48, 64, 12, 34
_INK, _GREY, _FOUND = (40, 40, 40), (190, 190, 190), (210, 60, 40)
_CHANNELS = ((200, 60, 60), (50, 150, 60), (60, 90, 210))
_USUAL = (40, 90, 190)
_TICKS = 5
_BAR = 0.7  # width of a bar, as a share of its place


def draw_deep(check: DeepCheck) -> np.ndarray:
    """Return the plot of a check, RGB uint8 [900, 1440, 3].

    The panels show reprojection error, time offset, exposure per channel, brightness and sharpness over time, repeated
    frames and overlap. Cameras with a finding are red; a question mark stands for what was not measured.
    """
    panels = [
        _bars(check, "error", "Reprojection error, px", check.errors[:, None], (0, 1)),
        _bars(check, "time", "Time offset, frames", check.offsets[:, None], (-1, 1)),
        _bars(check, "exposure", "Exposure of R, G, B, %", 100 * np.expm1(check.gains), (-10, 10)),
        _curves(check, ("variation", "flicker"), "Brightness over time, %", 100 * np.expm1(check.brightness), (-5, 5)),
        _curves(check, ("blur",), "Sharpness over time, octaves", check.sharpness, (-1, 1)),
        _events(check),
        _matrix(check),
        *_sentences(check, 2),
    ]
    return np.concatenate([np.concatenate(panels[row : row + 3], axis=1) for row in (0, 3, 6)])


def _blank(title: str) -> np.ndarray:
    panel = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    _text(panel, title, (_LEFT, 28), 0.55)
    return panel


def _bars(check: DeepCheck, question: str, title: str, values: np.ndarray, least: tuple[float, float]) -> np.ndarray:
    """Return a panel with a group of bars per camera, for values [C, K]; the axis contains the interval `least`."""
    panel, known = _blank(title), values[np.isfinite(values)]
    if not len(known):
        return _unmeasured(panel)
    row = _scale(panel, np.append(known, least))
    place = (_WIDTH - _LEFT - _RIGHT) / len(values)
    for view, group in enumerate(values):
        colors = _CHANNELS if len(group) == 3 else (_color(check, (question,), view),)
        for k, (value, color) in enumerate(zip(group, colors, strict=True)):
            left = _LEFT + place * (view + 0.5 + _BAR * (k / len(group) - 0.5))
            right = left + _BAR * place / len(group)
            if np.isfinite(value):
                cv2.rectangle(panel, (round(left), row(0)), (max(round(left), round(right) - 1), row(value)), color, -1)
            else:
                _text(panel, "?", (round((left + right) / 2) - 3, row(0) - 4), 0.38, _GREY)
        _label_camera(panel, check, question, view, place)
    return panel


def _curves(
    check: DeepCheck, questions: Sequence[str], title: str, values: np.ndarray, least: tuple[float, float]
) -> np.ndarray:
    """Return a panel with a curve per camera, for values [T, C]; those with a finding are drawn last."""
    panel, known = _blank(title), values[np.isfinite(values)]
    if not len(known):
        return _unmeasured(panel)
    row = _scale(panel, np.append(known, least))
    columns = np.linspace(_LEFT, _WIDTH - _RIGHT, len(values))
    for view in sorted(range(values.shape[1]), key=lambda view: _is_found(check, questions, view)):
        color = _color(check, questions, view)
        points = [(round(x), row(y)) for x, y in zip(columns, values[:, view], strict=True) if np.isfinite(y)]
        cv2.polylines(panel, [np.array(points, np.int32).reshape(-1, 1, 2)], False, color, 1, cv2.LINE_AA)
        if points and _is_found(check, questions, view):
            _text(panel, check.names[view], (points[-1][0] - 60, points[-1][1] - 5), 0.38, color)
    _label_frames(panel, check)
    return panel


def _events(check: DeepCheck) -> np.ndarray:
    """Return the panel of repeated frames: a row per camera, a column per frame."""
    panel = _blank("Repeated frames (red) and missing ones (grey)")
    top, bottom, count = _HEAD, _HEIGHT - _FOOT, len(check.names)
    edges = np.linspace(_LEFT, _WIDTH - _RIGHT, check.frames + 1).round().astype(int).tolist()
    rows = np.linspace(top, bottom, count + 1).round().astype(int).tolist()
    for view in range(count):
        cv2.line(panel, (_LEFT, rows[view + 1]), (_WIDTH - _RIGHT, rows[view + 1]), _GREY, 1)
        marks = [(frame, _GREY) for frame in np.flatnonzero(np.isnan(check.sharpness[:, view])).tolist()]
        for frame, color in [*marks, *((frame, _FOUND) for frame in check.repeated[view])]:
            corner = (max(edges[frame], edges[frame + 1] - 1), rows[view + 1] - 1)
            cv2.rectangle(panel, (edges[frame], rows[view] + 1), corner, color, -1)
        if rows[1] - rows[0] > 8:
            _text(panel, check.names[view][-8:], (4, (rows[view] + rows[view + 1]) // 2 + 4), 0.36)
    _label_frames(panel, check)
    return panel


def _matrix(check: DeepCheck) -> np.ndarray:
    """Return the panel of overlaps: the share of each row's image that each column's camera sees."""
    panel, count = _blank("Share of the row's image in the column's, %"), len(check.names)
    size = (_HEIGHT - _HEAD - _FOOT) // count
    for i, shares in enumerate(check.overlaps):
        for j, share in enumerate(shares):
            x, y = _LEFT + j * size, _HEAD + i * size
            shade = tuple(round(255 - s * share) for s in (200, 150, 50))
            cv2.rectangle(panel, (x, y), (x + size - 2, y + size - 2), (230, 230, 230) if i == j else shade, -1)
            if size >= 22 and i != j:
                _text(
                    panel, f"{100 * share:.0f}", (x + 2, y + size // 2 + 4), 0.34, _INK if share < 0.6 else (255,) * 3
                )
        if size > 8:
            color = _FOUND if _is_found(check, ("overlap",), i) else _INK
            _text(panel, check.names[i][-8:], (4, _HEAD + i * size + size // 2 + 4), 0.36, color)
    return panel


def _sentences(check: DeepCheck, count: int) -> list[np.ndarray]:
    """Return `count` panels with the findings, and what was not measured."""
    lines = [line for text in (*(f.sentence for f in check.findings), check.unmeasured) for line in _wrapped(text)]
    fitting = (_HEIGHT - _HEAD) // 16
    if len(lines) > count * fitting:
        lines = [*lines[: count * fitting - 1], "..."]
    panels = []
    for k in range(count):
        panel = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        if k == 0:
            _text(panel, f"Findings: {len(check.findings)}", (12, 28), 0.55)
        for n, line in enumerate(lines[k * fitting : (k + 1) * fitting]):
            _text(panel, line, (12, _HEAD + 12 + 16 * n), 0.38)
        panels.append(panel)
    return panels


def _wrapped(sentence: str) -> list[str]:
    from textwrap import wrap

    return wrap(sentence, 72, subsequent_indent="  ")


def _scale(panel: np.ndarray, values: np.ndarray) -> Callable[[float], int]:
    """Draw the axis of a panel and return the function from values to rows."""
    low, high = float(values.min()), float(values.max())

    def row(value: float) -> int:
        return round(_HEIGHT - _FOOT - (value - low) / (high - low) * (_HEIGHT - _FOOT - _HEAD))

    power = 10.0 ** np.floor(np.log10((high - low) / _TICKS))
    step = power * min(s for s in (1, 2, 5, 10) if s * power >= (high - low) / _TICKS)
    for value in step * np.arange(np.ceil(low / step), np.floor(high / step) + 1):
        cv2.line(panel, (_LEFT, row(value)), (_WIDTH - _RIGHT, row(value)), _INK if value == 0 else (230,) * 3, 1)
        _text(panel, f"{value:g}", (16, row(value) + 4), 0.38)
    return row


def _label_camera(panel: np.ndarray, check: DeepCheck, question: str, view: int, place: float) -> None:
    """Write the end of a camera's name, which differs between cameras, below its place."""
    color = _FOUND if _is_found(check, (question,), view) else _INK
    name = check.names[view][-max(1, int(place / 8)) :]
    _text(panel, name, (round(_LEFT + place * (view + 0.5) - 3.5 * len(name)), _HEIGHT - _FOOT + 20), 0.38, color)


def _label_frames(panel: np.ndarray, check: DeepCheck) -> None:
    _text(panel, "frame 0", (_LEFT, _HEIGHT - _FOOT + 20), 0.38)
    _text(panel, str(check.frames - 1), (_WIDTH - _RIGHT - 28, _HEIGHT - _FOOT + 20), 0.38)


def _unmeasured(panel: np.ndarray) -> np.ndarray:
    _text(panel, "not measured", (_LEFT, _HEIGHT // 2), 0.5, _GREY)
    return panel


def _is_found(check: DeepCheck, questions: Sequence[str], view: int) -> bool:
    return any(f.question in questions and check.names[view] in f.cameras for f in check.findings)


def _color(check: DeepCheck, questions: Sequence[str], view: int) -> tuple[int, int, int]:
    return _FOUND if _is_found(check, questions, view) else _USUAL


def _text(panel: np.ndarray, text: str, at: tuple[int, int], size: float, color: tuple[int, ...] = _INK) -> None:
    cv2.putText(panel, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
