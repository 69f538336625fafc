"""Tables and sentences of a sweep."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from morgs_mi.extras.sweep.statistics import (
    COST_TOLERANCE,
    DECIDING,
    DECIDING_INDICES,
    INDEX,
    SCORES,
    Means,
    level_lines,
    mean_of,
)
from morgs_mi.extras.sweep.sweep_scores import SweepScores

Table = Sequence[Sequence[str]]
"""Rows of a table, the first with the titles of the columns."""

AXES = {
    True: ("first frame", "steps", "first_seconds"),
    False: ("later frame", "epochs", "seconds"),
}
"""What is fitted, what is varied, and the score that has the seconds: of fits of the first frame
alone, and of others.
"""
# Scores of the tables, beside the seconds and the measure.
_SHOWN = ("psnr", "psnr_moving", "motion_error_moving", "kilobytes")


def sweep_report(result: SweepScores) -> tuple[dict[str, Table], str]:
    """Return the tables of a sweep by title, and its sentences: of the first frame alone and of
    later frames, the means, the paired differences, and the seconds for round values.
    """
    tables: dict[str, Table] = {}
    lines: list[str] = []
    means = mean_of(result.scores)
    score = SCORES[result.measure]
    for first_alone, (title, point, seconds) in AXES.items():
        curves = result.curves(first_alone)
        rows = np.sort(np.concatenate([np.zeros(0, int), *curves.values()]))
        others = rows[result.reference[rows] != rows]
        places = [INDEX[seconds], INDEX[result.measure]]
        points = {name: means.mean[k][:, places].T for name, k in curves.items()}
        lines += level_lines(title, points, score)
        names = select_names((seconds, result.measure, *_SHOWN), means.mean[rows])
        heads = {"config": result.names, point: result.points.astype(str)}
        tables[f"{title}: means over the seeds"] = _table(
            heads | _columns(names, drop_errors(means)), rows
        )
        names = select_names((seconds, result.measure, "kilobytes"), means.mean[rows])
        tables[f"{title}: changes from the first config ± standard errors of pairs"] = _table(
            heads | _columns(names, result.changes, "+"), others
        )
    return tables, "\n".join(lines)


def leave_out_tables(result: SweepScores) -> dict[str, Table]:
    """Return the table of `leave_out` by its title: the scores with all parts, the changes without
    each, and the reason why a part is needed.
    """
    means = mean_of(result.scores)
    names = select_names(("first_seconds", "seconds", *_SHOWN), means.mean)
    rows = np.union1d(np.flatnonzero(np.isfinite(result.scores[:1]).any((1, 2))), result.ablations)
    decides = np.zeros(means.mean.shape, bool)
    decides[:, DECIDING_INDICES] = result.excess > 1
    marks = np.where(decides, "*", " ")
    base = _columns(names, drop_errors(means), marks=marks)
    columns = _columns(names, drop_errors(result.changes), "+", marks)
    for title, cells in columns.items():
        cells[0] = base[title][0]
    heads = {"without": np.char.replace(result.names, "without ", "")}
    heads["without"][0] = "nothing"
    reasons = np.where(result.reasons == "", "not needed", result.reasons)
    reasons[0] = ""
    columns["needed\nbecause\nof"] = reasons
    title = "means over the seeds with all parts, and changes without (*: exceeds its bound)"
    return {title: _table(heads | columns, rows)}


def leave_out_sentence(result: SweepScores, parts: Sequence[str], tolerance: float) -> str:
    """Return the sentences of `leave_out`.

    Args:
        result: the scores.
        parts: that are not needed.
        tolerance: of PSNR, dB.
    """
    limits = f"Within {tolerance:g} dB and {100 * COST_TOLERANCE:g} %, this scene"
    lines = [f"{limits} needs each of the parts."]
    if parts:
        k = result.names.tolist().index(ablation_name(parts))
        cells = _columns(["psnr", "kilobytes"], result.changes, "+")
        psnr, size = (column[k] for column in cells.values())
        lines = [
            f"{limits} does not need {', '.join(parts)}: without, the PSNR changes by {psnr} dB, "
            f"the size of a later frame by {size} kB, and {_seconds_text(result, k)}."
        ]
    if result.scores.shape[1] == 1:
        lines.append(
            "With one seed there is no standard error: the tolerance alone decides, and seconds do "
            "not."
        )
    return "\n".join(lines)


def ablation_name(parts: Sequence[str]) -> str:
    """Return the name of the arm that lacks some parts."""
    return f"without {parts[0] if len(parts) == 1 else f'{len(parts)} together'}"


def _seconds_text(result: SweepScores, k: int) -> str:
    """Return in words how the seconds of a later frame change in an arm."""
    ratio = result.excess[k, DECIDING.index("seconds")]
    if np.isnan(ratio):
        return "its seconds were not compared, for lack of several fits that ran in turn"
    if abs(ratio) <= 1:
        return "its seconds by no more than their noise"
    times = _columns(["seconds"], drop_errors(mean_of(result.scores))).popitem()[1]
    return f"it takes {times[k]} s instead of {times[result.reference[k]]} s"


def drop_errors(means: Means) -> Means:
    """Return means whose standard errors are unknown."""
    return means._replace(error=np.full_like(means.error, np.nan))


def select_names(names: Iterable[str], values: np.ndarray) -> list[str]:
    """Return the names of the scores that some rows of values [R, N] have, each once."""
    return [name for name in dict.fromkeys(names) if np.isfinite(values[:, INDEX[name]]).any()]


def _columns(
    names: Sequence[str], means: Means, sign: str = "", marks: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return the cells of all arms [A] by the titles of the columns, with ± standard errors where
    they are known.

    Args:
        names: of the scores.
        means: of all arms.
        sign: "+": also of positive numbers.
        marks: [A, N] characters that follow; None: none do.
    """
    columns = {}
    for name in names:
        score = SCORES[name]
        values = means.mean[:, INDEX[name]]
        errors = means.error[:, INDEX[name]]
        cells = np.char.mod(f"%{sign}.{score.digits}f", values)
        bars = np.char.mod(f" ± %.{score.digits}f", errors)
        cells = np.where(np.isfinite(errors), np.char.add(cells, bars), cells)
        cells = np.where(np.isfinite(values), cells, "-")
        if marks is not None:
            cells = np.char.add(cells, marks[:, INDEX[name]])
        title = score.label.replace(", ", "\n").replace(" ", "\n")
        columns[title] = cells.astype(object)
    return columns


def _table(columns: Mapping[str, np.ndarray], rows: np.ndarray) -> Table:
    """Return a table of the arms with the indices `rows`, from the cells of all arms [A] by the
    titles of the columns.
    """
    cells = np.array([*columns.values()], object)
    return [[*columns], *cells[:, rows].T.tolist()]
