"""Every table of docs/experiments, by the name that a page gives it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from benchmarks.pages.results import committed
from benchmarks.reports import far_cameras, field, held_out, needed, stability, starts
from benchmarks.reports.plots import markdown
from benchmarks.speed import host, pairs


def study_table(report: Any, *names: str) -> str:
    """Return the table of a study over the committed fits of some results."""
    return report.Options().table([fit for name in names for fit in committed(name)["fits"]])


def demo() -> str:
    """Return the scores of the demo, with and without motion, offset and confidence."""
    comparison = committed("demo")["comparison"]
    rows = (
        (
            title,
            f"{row['psnr']:.2f} dB",
            f"{row['motion_error_moving']:.2f} px",
            f"{row['motion_error_still']:.2f} px",
        )
        for title, row in (
            ("default", comparison["full"]),
            ("residuals alone", comparison["plain"]),
        )
    )
    return markdown(("", "PSNR", "motion error, moving", "still"), rows)


def frame_times() -> str:
    """Return times of a later frame by epochs, and quality and bytes of two epochs, for a large and
    a small scene.
    """
    result = committed("frame_speed")
    rows = []
    for size in ("n3dv", "small"):
        rig = result[size]["size"]
        name = f"{rig['gaussians']:,}, {rig['views']} views of {rig['width']}x{rig['height']}"
        short, run = (result[size]["runs"][f"default, {epochs} epochs"] for epochs in (1, 2))
        scores = f"{run['psnr']:.2f}", f"{run['bytes'] / 1000:.0f}"
        shares = (f"{100 * run[key]:.0f} %" for key in ("gaussians", "pixels"))
        rows.append((name, f"{short['seconds']:.1f}", f"{run['seconds']:.1f}", *scores, *shares))
    titles = "1 epoch, s", "2 epochs, s", "PSNR, dB", "kB", "active Gaussians", "drawn pixels"
    return markdown(("Gaussians", *titles), rows)


def fuzz() -> str:
    """Return the number of damaged streams by fuzzer."""
    changes = {
        "damage": "truncated, flipped bits, overwritten ranges",
        "bytes": "up to three bytes of a packet, CRC made right",
        "packets": "tables, codes, kinds, order and index, CRC made right",
        "header": "entries of other types and ranges, or none",
    }
    rows = (
        (name, changes[name], f"{counts['streams']:,}")
        for name, counts in committed("fuzz")["fuzzers"].items()
    )
    return markdown(("fuzzer", "what is changed", "streams"), rows, left=2)


def trial_table(table: Callable[..., str]) -> str:
    """Return a table of the trial of branches."""
    return table(needed.rows_of(committed("what_is_needed")))


TABLES: Mapping[str, Callable[[], str]] = {
    "demo": demo,
    "far_cameras": partial(study_table, far_cameras, "far_cameras"),
    "field": lambda: field.field_table(committed("field")["fits"]),
    "frame_times": frame_times,
    "fuzz": fuzz,
    "held_out_views": lambda: held_out.first_frames(
        committed("held_out")["fits"], committed("held_out_seeds")["fits"]
    ),
    "host": lambda: host.sizes_table(committed("host")["sizes"]),
    "hard_fits": lambda: stability.fits_table(committed("stability")["rows"]),
    "extremes": lambda: stability.stability_table(committed("stability")["rows"]),
    "pairs": lambda: pairs.pairs_table(committed("pairs")["pairs"]),
    **{
        f"trial_{name}": partial(trial_table, table)
        for name, table in (
            ("branches", needed.branches_table),
            ("sets", needed.sets_table),
        )
    },
    "starts": partial(study_table, starts, "starts", "starts_far", "starts_rooms"),
    "unseen": lambda: field.scenes_table(committed("random_scenes")["fits"]),
}
