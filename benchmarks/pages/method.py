"""Tables of the pages on the method and on the methods of the field."""

from __future__ import annotations

import numpy as np

from benchmarks.pages.results import Scores, committed
from benchmarks.reports.plots import Column, grouped, markdown, means_over, scores_table

__all__ = [
    "demo",
    "drift",
    "early_stop",
    "field",
    "frame_stages",
    "frame_times",
    "gains",
    "momentum",
    "parts",
    "search",
    "unseen",
]


def demo() -> str:
    """Return the scores of the demo, with and without motion, offset and confidence."""
    found = committed("demo")["comparison"]
    rows = (
        (title, f"{row['psnr']:.2f} dB", f"{row['motion_error_moving']:.2f} px", f"{row['motion_error_still']:.2f} px")
        for title, row in (("default", found["full"]), ("residuals alone", found["plain"]))
    )
    return markdown(("", "PSNR", "motion error, moving", "still"), rows)


def unseen() -> str:
    """Return the scores of the random scenes that no setting was chosen on, and the spread of their means."""
    fits = committed("random_scenes")["fits"]
    columns = (
        Column("PSNR, dB", "psnr"),
        Column("moving, dB", "psnr_moving"),
        Column("IoU of the confidence", "confidence_iou"),
        Column("motion error, px", "motion_error_moving"),
        Column("kB", "bytes", 0, 1e-3, spread=False),
    )
    return scores_table([*fits, *means_over(fits, "fit_seed", seed="mean")], {"seed": "seed"}, columns)


def _best_rates(clip: Scores) -> dict[tuple[str, int], Scores]:
    """Return the mean scores of a clip by preset and epochs, at the best rates of the preset."""
    return {(row["preset"], row["epochs"]): row["mean"] for row in clip["rows"] if row["best"]}


def gains() -> str:
    """Return the gains of the default over the tuned baseline, and over the paper's scheme."""
    rows = []
    for clip in committed("method_report")["clips"]:
        for epochs in (2, 8):
            best = _best_rates(clip)
            ours, theirs, paper = (best[preset, epochs] for preset in ("default", "baseline", "paper"))
            added = (f"{ours[name] - theirs[name]:.2f}" for name in ("psnr", "psnr_moving"))
            share = ours["motion_error_moving"] / theirs["motion_error_moving"]
            over_paper = ours["psnr_moving"] - paper["psnr_moving"]
            rows.append((f"`{clip['name']}`", f"{epochs}", *added, f"{share:.2f}", f"{over_paper:.2f}"))
    titles = "PSNR, dB", "moving, dB", "motion error, share", "moving, over `paper`, dB"
    return markdown(("clip", "epochs", *titles), rows)


def parts() -> str:
    """Return the scores of the presets with one part more each, at 2 and 8 epochs."""
    (clip,) = committed("method_parts")["clips"]
    best, rows = _best_rates(clip), []
    for preset in ("baseline", "paper", "ml", "ml-mo", "ml-mo-mc"):
        short, long = best[preset, 2], best[preset, 8]
        psnrs = (f"{scores[name]:.2f}" for scores in (short, long) for name in ("psnr", "psnr_moving"))
        iou = "-" if long["confidence_iou"] is None else f"{long['confidence_iou']:.2f}"
        rest = f"{long['motion_error_moving']:.2f}", iou, f"{long['num_bytes'] / 1000:.1f}"
        rows.append((f"`{preset}`", *psnrs, *rest))
    titles = "2 epochs: PSNR, dB", "moving", "8 epochs: PSNR, dB", "moving", "motion error, px", "IoU", "kB"
    return markdown(("preset", *titles), rows)


def search() -> str:
    """Return the PSNR where things move without and with the coarse search, of every frame and of every second one."""
    titles = {
        ("stride_1", "without"): "every frame: without",
        ("stride_1", "search"): "with search",
        ("stride_2", "without"): "every second frame: without",
        ("stride_2", "search"): "with search",
    }
    fits = [
        {
            "seed": fit["seed"],
            "fit_seed": fit["fit_seed"],
            **{f"{stride} {how}": fit[stride][how]["psnr_moving"] for stride, how in titles},
        }
        for fit in committed("fast_parts")["fits"]
    ]
    columns = [Column(title, " ".join(case)) for case, title in titles.items()]
    return scores_table([*fits, *means_over(fits, "fit_seed", seed="mean")], {"seed": "seed"}, columns)


def drift() -> str:
    """Return the quality over thirty frames, of one fit or three."""
    fits, rows = [fit for name in ("drift", "drift_fresh") for fit in committed(name)["fits"]], []
    for (name,), own in grouped(fits, "clip").items():
        moving = [np.array(fit["psnr_moving"], float) for fit in own]
        known = [values[np.isfinite(values)] for values in moving]
        psnrs = (
            [np.mean(fit["psnr"]) for fit in own],
            *([values[at] for values in known] for at in (0, -1)),
            [values.mean() for values in known],
        )
        slope = np.mean([fit["slope_moving_db_a_frame"] for fit in own])
        iou = np.mean([np.nanmean(np.array(fit["confidence_iou"], float)) for fit in own])
        means = (f"{np.mean(values):.2f}" for values in psnrs)
        rows.append((f"`{name}`", f"{len(own)}", *means, f"{slope:+.3f}", f"{iou:.2f}"))
    titles = "fits", "PSNR, dB", "moving: first", "last", "mean", "slope, dB a frame", "IoU"
    return markdown(("clip", *titles), rows)


def frame_times() -> str:
    """Return time, quality and bytes of a later frame of a large and a small scene."""
    found, rows = committed("frame_speed"), []
    for size in ("n3dv", "small"):
        about = found[size]["size"]
        name = f"{about['gaussians']:,}, {about['views']} views of {about['width']}x{about['height']}"
        for epochs in (1, 2):
            run = found[size]["runs"][f"default, {epochs} epochs"]
            shares = (f"{100 * run[key]:.0f} %" for key in ("gaussians", "pixels"))
            rows.append(
                (
                    name,
                    f"{epochs}",
                    f"{run['seconds']:.1f}",
                    f"{run['psnr']:.2f}",
                    f"{run['bytes'] / 1000:.0f}",
                    *shares,
                )
            )
    return markdown(("Gaussians", "epochs", "s", "PSNR, dB", "kB", "active Gaussians", "drawn pixels"), rows)


def early_stop() -> str:
    """Return the scores of frames that end early or not, means over the scenes."""
    rows, fits = [], committed("early_stop")["fits"]
    columns = ("psnr", 1, 2), ("psnr_moving", 1, 2), ("bytes", 1e-3, 0), ("epochs", 100, 0), ("cpu_s", 1, 2)
    for (tolerance,), own in grouped(fits, "tolerance").items():
        means = (f"{factor * np.mean([fit[name] for fit in own]):.{digits}f}" for name, factor, digits in columns)
        rows.append(("never" if not tolerance else f"falls by less than {tolerance:.0%}", *means))
    return markdown(("ends early if the objective", "PSNR, dB", "moving", "kB", "epochs, %", "processor time, s"), rows)


def momentum() -> str:
    """Return the scores of later frames by the momentum of Adam, means over the scenes."""
    fits = [fit for fit in committed("steps")["fits"] if fit["fit_seed"] > 0]
    columns, rows = (("psnr", 1, 2), ("psnr_moving", 1, 2), ("bytes", 1e-3, 1), ("cpu_s", 1, 2)), []
    for (epochs, value), own in sorted(grouped(fits, "epochs", "momentum").items(), key=lambda item: item[0]):
        means = (f"{factor * np.mean([fit[name] for fit in own]):.{digits}f}" for name, factor, digits in columns)
        rows.append((f"{epochs}", f"{value:.2f}", *means))
    return markdown(("epochs", "momentum", "PSNR, dB", "moving", "kB", "processor time, s"), rows)


_STAGES = {
    "changes of the images": ("change",),
    "optical flow": ("flow",),
    "active set": ("part",),
    "targets": ("targets",),
    "lifted flow": ("lift",),
    "propagation": ("propagation",),
    "search": ("search",),
    "refinement, colour": ("refinement", "colour"),
    "steps": ("steps",),
    "births": ("density",),
    "packet, decoding": ("packet", "decoding"),
}


def frame_stages() -> str:
    """Return the times of the stages of a live frame, before and after passes were shared."""
    found, rows = committed("frame_speed")["speedup"], []
    runs = [found[size][version] for size in ("n3dv", "small") for version in ("before", "after")]
    for title, names in _STAGES.items():
        seconds = (sum(run.get(f"{name}_s", 0.0) for name in names) for run in runs)
        rows.append((title, *(f"{1000 * value:.0f}" if value else "not measured" for value in seconds)))
    rows.append(("whole frame", *(f"{1000 * run['seconds']:.0f}" for run in runs)))
    rows.append(("PSNR, dB", *(f"{run['psnr']:.2f}" for run in runs)))
    rows.append(("kB", *(f"{run['bytes'] / 1000:.0f}" for run in runs)))
    titles = (f"{size}, {version}" for size in ("large", "small") for version in ("before", "now"))
    return markdown(("ms", *titles), rows)


def field() -> str:
    """Return the scores of the methods at 8 epochs: means over the scenes, and the spread of some means."""
    cells = committed("field")["cells"]
    jaccard = "Dynamic 3D Gaussians average_jaccard"
    columns = (
        Column("PSNR, dB", "psnr", spread=False),
        Column("moving, dB", "psnr_moving"),
        Column("motion error, px", "motion_error_moving", spread=False),
        Column("in 3D, %", "motion_3d_relative_error", 0, 100, spread=False),
        Column("AJ, %", jaccard, 1, 100),
        Column("kB", "num_bytes", 1, 1e-3, spread=False),
        Column("CPU s", "cpu_s", 1, spread=False),
    )
    rows = []
    for name in next(iter(cells.values())):
        method, epochs = name.split("/")
        if epochs != "8":
            continue
        fits = [{"fit": cell.split("/")[1], **found[name]} for cell, found in cells.items()]
        rows += means_over(fits, "fit", method=f"`{method}`")
    return scores_table(rows, {"method": "method"}, columns)
