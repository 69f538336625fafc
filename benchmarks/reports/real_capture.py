"""Fit a recording and report quality per view, seconds, bytes and memory.

    python -m benchmarks.reports.real_capture CAPTURE OUT --downscale 2 --json out.json

Memory is the process's resident set, MiB, at the first step of a frame. Without a held-out view, quality is that of the
training views. A fit that OUT holds already is continued.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import tyro
from tyro.conf import Positional

from morgs_mi.capture.capture import load_capture
from morgs_mi.cli.settings import GivenReading, GivenSettings, Reading, Settings
from morgs_mi.core.files import write_json
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.recorder import stream_capture


@dataclass(frozen=True)
class Options:
    """Fit a recording and measure the result."""

    capture: Positional[Path]
    """Folder of the capture."""
    out: Positional[Path]
    """Output folder for the stream."""
    json: Path
    """JSON file for the figures."""
    frames: int | None = None
    """Maximum number of frames from the start."""
    downscale: float = 1
    """Factor by which the images are averaged down."""
    reading: GivenReading = field(default_factory=Reading)
    settings: GivenSettings = field(default_factory=Settings)


def resident() -> float:
    """Return this process's resident set, MiB."""
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * 4096 / 2**20


def fit(options: Options) -> None:
    """Fit the remaining frames and log the memory at every frame in OUT/memory.jsonl."""
    options.out.mkdir(parents=True, exist_ok=True)
    capture = load_capture(options.capture, options.downscale, "auto", options.frames, options.reading.read_config())
    with (options.out / "memory.jsonl").open("a", encoding="utf-8") as log:
        logged: set[int] = set()

        def log_memory(stage: str, done: float, total: float) -> None:
            frame = 1 + int(done) if stage == "Later frames" else 0
            if frame not in logged:
                logged.add(frame)
                log.write(json.dumps({"frame": frame, "resident_mib": resident()}) + "\n")
                log.flush()

        stream_capture(capture, options.out, options.settings.stream_config(), resume=True, progress=log_memory)


def summary(out: Path, capture: Path) -> dict[str, Any]:
    """Return the figures of the stream in `out`."""
    result = evaluate_stream(out, capture).as_dict()
    lines = (out / "memory.jsonl").read_text(encoding="utf-8").splitlines()
    memory = {row["frame"]: row["resident_mib"] for row in map(json.loads, lines)}
    keys = ("frame", "psnr", "psnr_moving", "ssim", "seconds", "num_bytes")
    rows = [{key: row[key] for key in keys} | {"resident_mib": memory.get(row["frame"])} for row in result["frames"]]
    views = {
        name: {key: scores[key] for key in ("psnr", "ssim", "delta_e")} for name, scores in result["views"].items()
    }
    whole = ("held_out", "num_frames", "complete", "psnr", "psnr_moving", "psnr_still", "psnr_slope", "ssim", "mtv")
    return {
        **{key: result[key] for key in (*whole, "seconds", "bytes", "playback")},
        "views": views,
        "frames": rows,
    }


def main() -> None:
    """Run the command line."""
    options = tyro.cli(Options, config=(tyro.conf.OmitSubcommandPrefixes,))
    mi.set_variant("llvm_ad_rgb")
    fit(options)
    settings = {"frames": options.frames, "downscale": options.downscale}
    settings |= {"reading": asdict(options.reading), "config": asdict(options.settings.stream_config())}
    result = {"capture": options.capture.name, "settings": settings, **summary(options.out, options.capture)}
    result |= {"machine": machine(), "versions": versions()}
    write_json(options.json, result)
    print(
        f"{options.json}: PSNR " + ", ".join(f"{name} {view['psnr']:.2f} dB" for name, view in result["views"].items())
    )


if __name__ == "__main__":
    main()
