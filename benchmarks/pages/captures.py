"""Tables of the pages on the first frame, on recordings and on live fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.pages.results import Scores, committed, span
from benchmarks.reports import held_out
from benchmarks.reports.cameras import recovered
from benchmarks.reports.plots import Column, grouped, markdown, plus_minus, scores_table
from benchmarks.reports.unseen import out_of_capture
from morgs_mi.fit.unseen_views import WIDEST

__all__ = [
    "cameras",
    "clocks",
    "clocks_mean",
    "dropping",
    "exposure",
    "far_views",
    "first_frame_captures",
    "first_frames",
    "held_out_views",
    "held_out_views_over_time",
    "live",
    "noise_aware",
    "photos_over_time",
    "points",
    "principal_points",
    "real_motion",
    "unseen_groups",
    "unseen_views",
]


def _held_out(fit: Scores) -> float:
    """Return the mean PSNR of the held-out views of a fit, dB."""
    return float(np.mean([view["psnr"] for view in fit["held_out"]]))


def points() -> str:
    """Return the held-out PSNR of four views by the points that the fits start from."""
    rows: dict[str, list[str]] = {}
    for own in grouped(committed("few_views_points")["fits"], "capture", "start").values():
        cell = f"{plus_minus([_held_out(fit) for fit in own])} ({own[0]['points']:,})"
        rows.setdefault(own[0]["capture"], []).append(cell)
    return markdown(("clip", "random", "triangulated", "stereo"), ((f"`{name}`", *row) for name, row in rows.items()))


def dropping() -> str:
    """Return the held-out PSNR of three views without and with dropping, by noise."""
    rows: dict[str, list[str]] = {}
    for own in grouped(committed("few_views_noisy")["fits"], "capture", "dropping").values():
        row = rows.setdefault(own[0]["capture"], [f"{own[0]['noise']:.3f}"])
        row.append(plus_minus([_held_out(fit) for fit in own]))
    ordered = sorted(rows.items(), key=lambda item: (float(item[1][0]) < 0.015, int(item[0].partition("-")[2])))
    return markdown(("clip", "noise", "p = 0", "p = 0.2"), ((f"`{name}`", *row) for name, row in ordered))


def far_views() -> str:
    """Return the held-out PSNR of three clean views without and with dropping, by the angle to the next camera."""
    fits = [fit for fit in committed("far_views")["fits"] if fit["steps"] == 1200 and fit["dropping"] in (0, 0.2)]
    rows = []
    for (seed, reach), own in sorted(grouped(fits, "seed", "reach").items(), key=lambda item: -item[0][1]):
        without, dropped = (next(fit["held_out"] for fit in own if fit["dropping"] == p) for p in (0, 0.2))
        rows.append((f"`random-{seed}`", f"{reach:.1f}", *(f"{x:.2f}" for x in (without, dropped, dropped - without))))
    return markdown(("clip", "reach, degrees", "p = 0", "p = 0.2", "gain"), rows)


def first_frames() -> str:
    """Return the held-out PSNR and the processor time of first frames, before and now."""
    rows = []
    for (clip, views, noise), own in grouped(committed("generalise")["fits"], "clip", "views", "noise").items():
        fits = [next(fit for fit in own if fit["variant"] == variant) for variant in ("before", "default")]
        digits = {"held_out": 2, "cpu_s": 0}
        pairs = (" / ".join(f"{fit[key]:.{count}f}" for fit in fits) for key, count in digits.items())
        rows.append((f"`{clip}`", f"{views}", f"{noise:g}", *pairs, f"{fits[1]['cpu_s'] / fits[0]['cpu_s']:.2f}"))
    titles = "held out, dB", "processor time, s", "ratio"
    return markdown(("clip", "views", "noise", *titles), rows)


def first_frame_captures() -> str:
    """Return the held-out PSNR, the steps and the processor time of first frames, before and now."""
    rows = []
    for (case,), own in grouped(committed("first_frame_captures")["fits"], "case").items():
        fits = [next(fit for fit in own if fit["variant"] == variant) for variant in ("before", "default")]
        digits = {"held_out": 2, "steps": 0, "cpu_s": 0}
        pairs = (" / ".join(f"{fit[key]:.{count}f}" for fit in fits) for key, count in digits.items())
        rows.append((case, *pairs, f"{fits[1]['cpu_s'] / fits[0]['cpu_s']:.2f}"))
    return markdown(("capture", "held out, dB", "steps", "processor time, s", "ratio"), rows)


def noise_aware() -> str:
    """Return the held-out PSNR of the first frame by its loss."""
    found = grouped(committed("priors_noisy")["fits"], "case", "prior")
    rows = (
        (case, *(plus_minus([fit["held_out"] for fit in found[case, prior]]) for prior in ("none", "no D-SSIM")))
        for case in dict.fromkeys(case for case, _ in found)
    )
    return markdown(("capture", "L1 and D-SSIM, dB", "L1 alone, dB"), rows)


def cameras() -> str:
    """Return the quality that refinement restores, by the error of the poses, and of denied lenses."""
    fits, rows = committed("cameras")["fits"], []
    groups = {
        f"poses off by {degrees:g} degrees": own
        for (degrees,), own in sorted(grouped((fit for fit in fits if not fit["lens"]), "degrees").items())
    }
    for name, own in (groups | {"lenses ignored": [fit for fit in fits if fit["lens"]]}).items():
        psnrs = (f"{np.mean([fit[how]['registered'] for fit in own]):.1f}" for how in ("true", "disturbed", "refined"))
        rotations = span((fit["refined"]["rotation"] for fit in own), 2)
        rows.append((name, *psnrs, f"{span((100 * recovered(fit) for fit in own), 0)} %", rotations))
    titles = "true cameras, dB", "disturbed", "refined", "recovered", "rotation after, degrees"
    return markdown(("error", *titles), rows)


def principal_points() -> str:
    """Return the PSNR of photos by their calibration."""
    columns = (
        Column("training views, dB", "training", spread=True),
        Column("held out, as calibrated", "held_out", spread=True),
        Column("registered", "registered", spread=True),
        Column("difference", lambda fit: fit["registered"] - fit["held_out"], spread=False),
    )
    keys = {"photos": "set", "principal points": "principal_points", "held out": "held_out_views"}
    return scores_table(committed("real")["fits"], keys, columns, left=2)


def photos_over_time() -> str:
    """Return the quality and the work of first frames of photos by the time that they may take."""
    rows = (
        (
            fit["set"],
            f"{fit['seconds']:.0f}",
            f"{fit['cpu_s'] / 2:.0f}",
            f"{fit['gaussians']:,}",
            f"{fit['steps']:,}",
            *(f"{fit[score]:.2f}" for score in ("training", "held_out", "registered")),
        )
        for fit in committed("real_seconds")["fits"]
    )
    titles = "may take, s", "processor time of two cores, s", "Gaussians", "steps", "training views, dB"
    return markdown(("photos", *titles, "held out", "registered"), rows)


def unseen_views() -> str:
    """Return the forecasts of views between the cameras on captures that the regression has not seen."""
    rows = []
    for (name,), own in grouped(out_of_capture(committed("unseen")["fits"]), "set").items():
        figures = (span(row[score] for row in own) for score in ("training", "mean", "forecast", "width"))
        views = span((row["views"] for row in own), 0)
        rows.append((name, views, f"{len(own)}", *figures, f"{sum(row['within'] for row in own)} of {len(own)}"))
    titles = "training views, dB", "held-out views, dB", "forecast, dB", "interval, dB", "in it"
    return markdown(("capture", "views", "fits", *titles), rows)


def unseen_groups() -> str:
    """Return coverage and width of the intervals by kind of capture, of all fits and of those with a number."""
    rows = []
    fits = list(out_of_capture(committed("unseen")["fits"]))
    for kind, group in [*((kind, group) for (kind,), group in grouped(fits, "kind").items()), ("all", fits)]:
        narrow = [row for row in group if row["width"] <= WIDEST]
        widths = f"{np.median([row['width'] for row in narrow]):.1f}"
        shares = (f"{sum(row['within'] for row in part)} of {len(part)}" for part in (group, narrow))
        rows.append((kind, f"{len(grouped(group, 'set'))}", *shares, widths))
    titles = "fits in the interval", "of those with a number", "median width of these, dB"
    return markdown(("kind", "captures", *titles), rows)


def held_out_views() -> str:
    """Return the PSNR of the held-out views of recordings in the first frame."""
    return held_out.first_frames(committed("held_out")["fits"])


def held_out_views_over_time() -> str:
    """Return the scores of the held-out views of recordings over the frames."""
    return held_out.later_frames(committed("held_out")["fits"])


def real_motion() -> str:
    """Return the PSNR of recordings over their frames: where things move, and in the whole image."""
    rows = []
    for fit in committed("real_motion")["fits"]:
        moving = [value for value in fit["psnr_moving"] if value is not None]
        name = fit["recording"] + ("" if len(fit["keyframes"]) == 1 else f", also a keyframe at {fit['keyframes'][1]}")
        views = "training" if fit["held_out"] is None else fit["held_out"]
        figures = (moving[0], min(moving), moving[-1], fit["psnr"][0], fit["psnr"][-1])
        rows.append((name, views, f"{len(fit['psnr'])}", *(f"{value:.1f}" for value in figures)))
    titles = "moving, dB: first", "lowest", "last", "whole image: first", "last"
    return markdown(("recording", "views", "frames", *titles), rows, left=2)


def clocks() -> str:
    """Return the errors of the time offsets of each scene, and the PSNR where things move with and without them."""
    names = "synchronised", "recorded", "aligned"
    scenes, rows = grouped(committed("timing")["fits"], "scene"), []
    for (scene,), own in scenes.items():
        errors = (f"{own[0][error]:.3f}" for error in ("mean_error", "largest_error"))
        psnrs = (plus_minus([fit[f"{name}_moving"] for fit in own]) for name in names)
        rows.append((scene, f"{own[0]['views']:.0f}", *errors, *psnrs))
    means = (f"{_mean_over(scenes, f'{name}_moving'):.2f}" for name in names)
    rows.append(("mean", "", "", "", *means))
    return markdown(("scene", "views", "mean error", "largest", "synchronised, dB", "apart", "aligned"), rows)


def clocks_mean() -> str:
    """Return the errors of the time offsets over all scenes, and the PSNR where things move, means over the scenes."""
    scenes = grouped(committed("timing")["fits"], "scene")
    row = [
        span((own[0]["mean_error"] for own in scenes.values()), 2),
        f"{max(own[0]['largest_error'] for own in scenes.values()):.2f}",
        *(f"{_mean_over(scenes, f'{name}_moving'):.1f} dB" for name in ("synchronised", "recorded", "aligned")),
    ]
    titles = "mean error, frames", "largest error", "synchronised", "clocks apart", "aligned"
    return markdown(titles, [row], left=0)


def _mean_over(scenes: Mapping[tuple[str, ...], Sequence[Scores]], score: str) -> float:
    """Return the mean over the scenes of a score's mean over the fits."""
    return float(np.mean([np.mean([fit[score] for fit in own]) for own in scenes.values()]))


def exposure() -> str:
    """Return the PSNR with matched colours of equal and disturbed cameras, and the share that comes back."""
    found = grouped(committed("exposure")["fits"], "seed", "cameras", "exposure")
    rows = []
    for seed in dict.fromkeys(seed for seed, *_ in found):
        cases = [
            [fit["psnr_matched"] for fit in found[seed, cameras, mode]]
            for cameras in ("equal", "disturbed")
            for mode in ("off", "auto")
        ]
        equal, _, off, auto = (np.mean(values) for values in cases)
        rows.append((f"{seed}", *map(plus_minus, cases), f"{100 * (auto - off) / (equal - off):.0f} %"))
    return markdown(("seed", "equal: off, dB", "auto", "disturbed: off, dB", "auto", "recovered"), rows)


def live() -> str:
    """Return the PSNR where things move by stride, without a gap and after it."""
    found = committed("live")
    fewest = min(fit["epochs"] for fit in found["fits"])
    fits = grouped((fit for fit in found["fits"] if fit["epochs"] == fewest), "clip", "stride", "second")
    strides, rows = sorted({stride for _, stride, _ in fits}), []
    for clip in dict.fromkeys(clip for clip, *_ in fits):
        for label in ("continued", "after the gap"):
            own = (fits[clip, n, n if label == "continued" else found["gap"]] for n in strides)
            psnrs = ([float(np.mean(list(fit["psnr_moving"].values()))) for fit in of_stride] for of_stride in own)
            rows.append((f"`{clip}`", label, *map(plus_minus, psnrs)))
    return markdown(("clip", "", *(f"n = {n}" for n in strides)), rows, left=2)
