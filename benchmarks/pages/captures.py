"""Tables of the pages on the first frame, on recordings and on live fits."""

from __future__ import annotations

import numpy as np

from benchmarks.pages.results import CHOSEN_ON, Scores, committed, fits_by_cell, span, spreads
from benchmarks.reports.plots import grouped, markdown, plus_minus

__all__ = [
    "cameras",
    "clocks",
    "clocks_mean",
    "disturbances",
    "dropping",
    "estimates",
    "exposure",
    "live",
    "noise_aware",
    "points",
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


def noise_aware() -> str:
    """Return the held-out PSNR of the first frame by its loss."""
    found = grouped(committed("priors_noisy")["fits"], "case", "prior")
    rows = (
        (case, *(plus_minus([fit["held_out"] for fit in found[case, prior]]) for prior in ("none", "no D-SSIM")))
        for case in dict.fromkeys(case for case, _ in found)
    )
    return markdown(("capture", "L1 and D-SSIM, dB", "L1 alone, dB"), rows)


def estimates() -> str:
    """Return how many estimates are within 1.5 dB by number of views, on both groups of scenes."""
    fits, rows = committed("estimates")["fits"], []
    for (views,), own in sorted(grouped(fits, "views").items()):
        row = [f"{views}"]
        for some in ([fit for fit in own if (fit["seed"] in CHOSEN_ON) == chosen] for chosen in (True, False)):
            errors = np.array([fit["estimate"] - fit["held_out"] for fit in some])
            row += [f"{(abs(errors) <= 1.5).sum()} of {len(errors)}", span(errors)]
        rows.append(row)
    titles = "chosen on: within 1.5 dB", "error, dB", "fresh: within 1.5 dB", "error, dB"
    return markdown(("views", *titles), rows)


def disturbances() -> str:
    """Return what each kind of disturbance costs."""
    digits = {"psnr": 2, "psnr_moving": 2, "motion_error_moving": 2, "confidence_iou": 2}
    rows = ((name, *spreads(own, digits)) for name, own in fits_by_cell(committed("disturbances")["cells"]).items())
    return markdown(("disturbance", "PSNR, dB", "moving, dB", "motion error, px", "IoU of the confidence"), rows)


def cameras() -> str:
    """Return what refinement brings back, by the error of the poses, and of denied lenses."""
    found = committed("cameras")
    groups = {
        f"poses off by {degrees:g} degrees": own
        for (degrees,), own in sorted(grouped(found["fits"], "degrees").items())
    }
    rows = []
    for name, own in (groups | {"lenses ignored": found["lenses"]}).items():
        psnrs = (f"{np.mean([fit[how]['registered'] for fit in own]):.1f}" for how in ("true", "disturbed", "refined"))
        rotations = span((fit["refined"]["rotation"] for fit in own), 2)
        rows.append((name, *psnrs, f"{span((100 * fit['recovered'] for fit in own), 0)} %", rotations))
    titles = "true cameras, dB", "disturbed", "refined", "recovered", "rotation after, degrees"
    return markdown(("error", *titles), rows)


def clocks() -> str:
    """Return the errors of the time offsets of each scene, and the PSNR where things move with and without them."""
    names = "synchronised", "recorded", "aligned"
    scenes, rows = committed("timing")["scenes"], []
    for scene, row in scenes.items():
        errors = (f"{row[error]:.3f}" for error in ("mean_error", "largest_error"))
        rows.append((scene, f"{row['views']:.0f}", *errors, *(plus_minus(row[name]["moving"]) for name in names)))
    means = (f"{np.mean([np.mean(row[name]['moving']) for row in scenes.values()]):.2f}" for name in names)
    rows.append(("mean", "", "", "", *means))
    return markdown(("scene", "views", "mean error", "largest", "synchronised, dB", "apart", "aligned"), rows)


def clocks_mean() -> str:
    """Return the errors of the time offsets over all scenes, and the PSNR where things move, means over the scenes."""
    scenes = committed("timing")["scenes"].values()
    row = [
        span((scene["mean_error"] for scene in scenes), 2),
        f"{max(scene['largest_error'] for scene in scenes):.2f}",
        *(
            f"{np.mean([np.mean(scene[name]['moving']) for scene in scenes]):.1f} dB"
            for name in ("synchronised", "recorded", "aligned")
        ),
    ]
    titles = "mean error, frames", "largest error", "synchronised", "clocks apart", "aligned"
    return markdown(titles, [row], left=0)


def exposure() -> str:
    """Return the PSNR with matched colours of equal and disturbed cameras, and the share that comes back."""
    found = fits_by_cell(committed("exposure")["fits"], " ")
    rows = []
    for seed in dict.fromkeys(name.split()[0] for name in found):
        cases = [
            [fit["psnr_matched"] for fit in found[f"{seed} {case}"]]
            for case in ("equal off", "equal auto", "disturbed off", "disturbed auto")
        ]
        equal, _, off, auto = (np.mean(values) for values in cases)
        rows.append((seed, *map(plus_minus, cases), f"{100 * (auto - off) / (equal - off):.0f} %"))
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
