"""Tables of the pages on flow, masks, the stream, workers, the renderer and surfaces."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.pages.results import Scores, committed, span
from benchmarks.reports.plots import grouped, markdown, plus_minus

__all__ = [
    "accuracy",
    "codec",
    "codec_speed",
    "flow",
    "fuzz",
    "mask_fits",
    "masks",
    "modelled",
    "peer_photos",
    "peers",
    "splat_files",
    "stages",
    "steps",
    "surfaces",
    "workers",
]


def flow() -> str:
    """Return time and error where things move of each flow method on three clips."""
    clips = committed("flow_report")["clips"]
    rows: dict[str, list[str]] = {}
    for clip in clips:
        for row in clip["rows"]:
            rows.setdefault(row["method"], []).extend((f"{row['ms']:.0f}", f"{row['moving']['error']:.2f}"))
    titles = (title for clip in clips for title in (f"{clip['name']}: ms", "error, px"))
    return markdown(("method", *titles), ((f"`{method}`", *row) for method, row in rows.items()))


def masks() -> str:
    """Return the IoU of each kind of mask with the true mask."""
    clips = committed("masks")["fits"]
    rows = (
        (
            "lifted confidence" if method == "lifted" else f"`{method}`",
            *(f"{clip['masks'][method]['iou']:.2f}" for clip in clips),
            span((clip["processor_ms"][method] for clip in clips), 0) if method in clips[0]["processor_ms"] else "",
        )
        for method in clips[0]["masks"]
    )
    return markdown(("IoU", *(f"`{clip['name']}`" for clip in clips), "ms"), rows)


def mask_fits() -> str:
    """Return the IoU of the fitted confidence and the PSNR where things move, by the kind of mask."""
    clips, rows = grouped(committed("masks_fresh")["fits"], "name"), []
    for start, label in (("lifted", "lifted"), ("as before", "as in the paper")):
        for method in next(iter(clips.values()))[0]["loops"][start]:
            cells = []
            for own in clips.values():
                found = [clip["loops"][start][method]["held_out"] for clip in own]
                iou = np.mean([fit["iou"] for fit in found])
                cells.append(f"{iou:.2f}, {plus_minus([fit['psnr_moving'] for fit in found])} dB")
            rows.append((f"{label}, `{method}`", *cells))
    return markdown(("start, masks", *(f"`{name}`" for (name,) in clips)), rows)


def codec() -> str:
    """Return quality and bytes of a later frame by the setting of the codec."""
    rows = []
    for clip in committed("codec_report")["clips"]:
        for row in clip["rows"]:
            kilobytes = (f"{row[name] / 1000:.1f}" for name in ("later", "lzma"))
            times = f"{row['encode_ms']:.0f}", f"{row['decode_ms']:.0f}"
            psnrs = f"{row['psnr']['later']:.2f}", f"{row['loss'] + 0.0:.2f}".replace("-0.00", "0.00")
            rows.append((f"`{clip['name']}`", f"{row['quality']:g}", *psnrs, *kilobytes, *times))
    titles = "quality", "PSNR, dB", "loss, dB", "kB", "kB by lzma", "encode ms", "decode ms"
    return markdown(("clip", *titles), rows)


def codec_speed() -> str:
    """Return time and error of the codec by number of Gaussians."""
    rows = (
        (
            *(f"{row[name]:,}" for name in ("gaussians", "moving")),
            f"{row['bytes'] / 1000:.0f}",
            *(f"{row[name]:.0f}" for name in ("encode_ms", "decode_ms")),
            *(f"{row[name]:.3f}" for name in ("error_px_rms", "error_px_max")),
        )
        for row in committed("codec_speed")["rows"]
    )
    return markdown(("Gaussians", "moving", "kB", "encode ms", "decode ms", "error, px RMS", "largest"), rows, left=0)


def splat_files() -> str:
    """Return the times of the commands for files of Gaussians by number of Gaussians."""
    rows = (
        (
            f"{row['gaussians']:,}",
            f"{row['file_megabytes']:.0f}",
            *(f"{row[name]:.1f}" for name in ("open_seconds", "first_image_seconds", "image_seconds", "page_seconds")),
            f"{row['page_megabytes']:.0f}",
        )
        for row in committed("splat_files")["rows"]
    )
    titles = "Gaussians", "file, MB", "open, s", "first image, s", "image, s", "web page, s", "page, MB"
    return markdown(titles, rows, left=0)


def fuzz() -> str:
    """Return the number of damaged streams and of refusals by fuzzer."""
    changes = {
        "damage": "truncated, flipped bits, overwritten ranges",
        "bytes": "up to three bytes of a packet, CRC made right",
        "packets": "tables, codes, kinds, order and index, CRC made right",
        "header": "entries of other types and ranges, or none",
    }
    rows = (
        (name, changes[name], f"{found['streams']:,}", f"{sum(found['refusals'].values()):,}")
        for name, found in committed("fuzz")["fuzzers"].items()
    )
    return markdown(("fuzzer", "what is changed", "streams", "refusals"), rows, left=2)


def workers() -> str:
    """Return wall time and efficiency by number of workers."""
    found = committed("scaling")
    rows = (
        (f"{run['workers']}", f"{run['seconds']:.0f} s", f"{share['frames']:.2f}", f"{share['whole']:.2f}")
        for run, share in zip(found["runs"], found["efficiency"], strict=True)
    )
    return markdown(("workers", "whole fit", "efficiency, later frames", "efficiency, whole fit"), rows)


def modelled() -> str:
    """Return the modelled time of a long recording by number of workers."""
    rows = (
        (f"{row['workers']}", f"{row['seconds'] / 3600:.1f} h", f"{100 * row['efficiency']:.0f} %", row["bottleneck"])
        for row in committed("scaling")["model"]
    )
    return markdown(("workers", "time", "efficiency", "bottleneck"), rows)


def steps() -> str:
    """Return the time of an optimisation step, and its ratio to hand-written code."""
    names = {
        "W1": "20k Gaussians, 512x384",
        "W2b": "100k Gaussians, 1352x1014",
        "W2": "the same, splats twice as large",
    }
    rows = []
    for workload, name in names.items():
        run = committed(f"render_speed_{workload}")
        times = (
            f"{run[key]:.0f} ms" if run.get(key) else "not run"
            for key in ("step_ms", "plain_step_ms", "volprim_step_ms")
        )
        step, plain, volprim = times
        rows.append((name, step, f"{run['ratio_to_yardstick']:.2f}", plain, volprim))
    titles = "step", "ratio to tuned C++", "one lane per pixel", "`volprim_rf_basic`"
    return markdown(("", *titles), rows)


def accuracy() -> str:
    """Return error and time of the renderer by setting."""
    shown = {
        "alpha_min": ("1/16320", "1/2040", "1/255", "4/255"),
        "stop_transmittance": ("0", "1e-05", "0.0001", "0.001", "0.01"),
        "block": ("4x4", "8x4", "8x8"),
        "reproducible": ("true",),
    }
    rows = []
    for row in committed("renderer_report")["rows"]:
        if row["value"] not in shown.get(row["knob"], ()):
            continue
        name = f"`{row['knob']}` {row['value']}"
        errors = [error for kind in (row, row["rounding"]) for error in (kind["image"]["rms"], _worst(kind))]
        rows.append(
            (
                f"**{name}**" if row["default"] else name,
                f"{row['step_ratio']:.2f}",
                *(f"{error:.1e}" for error in errors),
            )
        )
    return markdown(("setting", "time of a step", "image", "gradients", "image, same cut-off", "gradients"), rows)


def _worst(errors: Scores) -> float:
    return max(row["relative_l2"] for row in errors["gradients"].values())


def stages() -> str:
    """Return the time of the stages of an optimisation step."""
    found = committed("instructions")["workloads"]
    rows = [(stage, *(_with_share(run["milliseconds"], stage) for run in found)) for stage in found[0]["milliseconds"]]
    return markdown(("stage, ms", *(run["workload"].removesuffix(".npz") for run in found)), rows)


def _with_share(milliseconds: Mapping[str, float], stage: str) -> str:
    share = 100 * milliseconds[stage] / milliseconds["step"]
    return f"{milliseconds[stage]:.1f}" + ("" if stage == "step" else f" ({share:.0f} %)")


def surfaces() -> str:
    """Return the times of splats, of surfaces, of both together, and of a shadow."""
    rows = (
        (
            f"{row['gaussians']:,}, {row['width']}x{row['height']}",
            *(f"{row[name]:.2f}" for name in ("splats", "surfaces", "both", "together", "shadow_ratio")),
        )
        for row in committed("surfaces_speed")["scenes"]
    )
    return markdown(("Gaussians, view", "splats", "surfaces", "both", "ratio to the sum", "shadow"), rows)


def peers() -> str:
    """Return the time of a step of this package and of peers, and the difference of their gradients."""
    found = committed("peers_steps")
    programs = ("ours", "ydah kernels", "volprim_rf_basic", "gsplat, PyTorch")
    rows = []
    for name, scene in {**found["scenes"], "300 Gaussians, 96x72": found["small"]}.items():
        times = [f"{scene['ms'][p]:.1f} ms" if p in scene["ms"] else "not run" for p in programs]
        rows.append((name, *times, f"{max(scene['gradients'].values()):.0e}"))
    titles = "ours", "kernels of ydah/gsplat", "`volprim_rf_basic`", "gsplat, PyTorch", "gradients differ by"
    return markdown(("", *titles), rows)


def peer_photos() -> str:
    """Return the held-out PSNR of OpenSplat and of this package over the seconds."""
    rows = [
        (
            f"`{fit['capture']}`",
            fit["photo"],
            fit["program"],
            *(f"{fit[name]:,}" for name in ("seconds", "gaussians", "mb")),
            f"{fit['psnr']:.1f}",
        )
        for fit in committed("peers_photos")["fits"]
    ]
    return markdown(("photos", "held out", "program", "s", "Gaussians", "memory, MB", "PSNR, dB"), rows)
