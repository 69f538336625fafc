"""PSNR and flicker at the seams of fits in segments, compared with the frames around and with fits in one piece.

    python -m benchmarks.reports.seams --fit-seeds 0 1 2 --json benchmarks/results/seams.json

The settings of the seams were chosen on `arm`, `spheres`, `thin` and `flicker` with seed 0; nothing was chosen on
others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import tyro

from benchmarks.reports.plots import markdown, plus_minus
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.executor import open_workers
from morgs_mi.cluster.seams import score_seam
from morgs_mi.cluster.segments import stream_segments
from morgs_mi.codec.reader import StreamReader
from morgs_mi.config import StreamConfig
from morgs_mi.fit.config import FitConfig
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(Output):
    """Clips and work."""

    clips: tuple[tuple[str, int, int], ...] = (
        ("arm", 0, 48),
        ("random", 5, 32),
        ("random", 34, 32),
        ("random", 35, 32),
        ("thin", 0, 32),
        ("flicker", 0, 32),
        ("spheres", 0, 32),
    )
    """Scenes, seeds and numbers of frames."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each clip."""
    folder: Path = Path("out/seams")
    """Folder of the clips, which are made if missing."""
    cameras: int = 6
    """Cameras of a clip, one of them held out."""
    width: int = 160
    """Width of its images, px; the height is three quarters of it."""
    gaussians: int = 4000
    """Gaussians of the first frame."""
    first_frame_steps: int = 500
    """Steps of the first frame."""
    epochs: int = 2
    """Epochs of a later frame."""
    segment_frames: int = 16
    """Frames of a segment."""
    workers: int = 1
    """Processes."""


def clip(name: str, seed: int, frames: int, options: Options) -> Capture:
    """Return a clip, which is made if it is missing."""
    path = options.folder / f"{name}-{seed}-{options.cameras}x{frames}x{options.width}"
    if not path.exists():
        width, height = options.width, options.width * 3 // 4
        config = SynthConfig(cameras=options.cameras, frames=frames, width=width, height=height, seed=seed)
        synthesize(name, path, config)
    return load_capture(path)


def measure(capture: Capture, config: StreamConfig, options: Options) -> dict[str, Any]:
    """Return the scores of the seams, those of a fit in one piece at the same frames, and the sizes of both."""
    with TemporaryDirectory() as name, open_workers(count=options.workers) as workers:
        segments, whole = (Path(name) / part for part in ("segments", "whole"))
        count = capture.num_frames // options.segment_frames
        fit = stream_segments(capture, segments, workers, config, count)
        stream_segments(capture, whole, workers, config)
        streams = [folder / "stream.morgs" for folder in (segments, whole)]
        same = [score_seam(StreamReader(streams[1]), capture, seam.frame) for seam in fit.seams]
        sizes = [path.stat().st_size for path in streams]
    seams = [{**asdict(seam), "whole": asdict(other)} for seam, other in zip(fit.seams, same, strict=True)]
    return {"num_bytes": sizes[0], "num_bytes_whole": sizes[1], "seams": seams}


def seam_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the seams of the clips as a table: each against the frames around, and beside the fit in one piece."""
    seams: dict[tuple[str, int, int], list[tuple[Mapping[str, Any], float]]] = {}
    for fit in fits:
        for seam in fit["seams"]:
            growth = fit["num_bytes"] / fit["num_bytes_whole"]
            seams.setdefault((fit["scene"], fit["seed"], seam["frame"]), []).append((seam, growth))
    rows = []
    for (scene, seed, frame), found in seams.items():
        own, growths = zip(*found, strict=True)
        columns = (
            [seam["psnr_around"] for seam in own],
            [seam["psnr"] - seam["psnr_around"] for seam in own],
            [seam["whole"]["psnr"] for seam in own],
            [seam["mtv"] / seam["mtv_around"] for seam in own],
            growths,
        )
        rows.append((f"`{scene}` {seed}, frame {frame}", *(plus_minus(values) for values in columns)))
    titles = "PSNR around, dB", "at the seam, against that", "PSNR in one piece", "mTV, ratio to around", "size, ratio"
    return markdown(("clip, seam", *titles), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    fit = FitConfig(
        num_gaussians=options.gaussians,
        first_frame_steps=options.first_frame_steps,
        epochs=options.epochs,
        dropping=0.0,
    )
    given, rows = {n: v for n, v in asdict(options).items() if n not in ("json", "folder")}, []
    for (name, seed, frames), fit_seed in product(options.clips, options.fit_seeds):
        found = measure(clip(name, seed, frames, options), StreamConfig(fit=fit, seed=fit_seed), options)
        rows.append({"scene": name, "seed": seed, "fit_seed": fit_seed, "frames": frames, **found})
        print(rows[-1], flush=True)
        options.write({"options": given, "clips": rows}, unprinted=["options", "clips"])


if __name__ == "__main__":
    main(tyro.cli(Options))
