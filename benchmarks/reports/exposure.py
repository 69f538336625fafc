"""Cameras whose exposures differ and change: what they cost, and what estimating them in the fit brings back.

    python -m benchmarks.reports.exposure --seeds 3 4 --json out.json

Each scene is `morgs-mi synth random --seed SEED`, recorded twice: by equal cameras, and by cameras whose exposures
differ, drift and vary from frame to frame. Both are fitted with `fit.exposure` off and auto. Scores are means over all
frames of the held-out view, whose exposure is as it should be: as recorded, and after the gain and bias per channel
that fit best, because only differences between cameras are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop
from morgs_mi import rasterize
from morgs_mi.capture.capture import load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.temporal import StillVariation
from morgs_mi.method.exposure import follow_exposure
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.synth.disturbances import Disturbances
from morgs_mi.synth.ground_truth import load_truth
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

__all__ = ["Options", "exposure_table", "main"]

_DISTURBED = Disturbances(exposure_gain=0.2, exposure_drift=0.15, exposure_flicker=0.02)
_ROWS = {"equal": Disturbances(), "disturbed": _DISTURBED}


@dataclass(frozen=True, kw_only=True)
class Options(CellOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each scene."""
    clips: Path = Path("out/exposure")
    """Folder of the clips, which are made if they are not there."""
    width: int = 160
    """Width of the images in pixels; the height is three quarters of it."""
    frames: int = 6
    """Number of frames."""
    num_gaussians: int = 4000
    """Gaussians of the first frame."""
    first_frame_steps: int = 600
    """Optimisation steps of the first frame."""
    epochs: int = 4
    """Epochs of a later frame."""

    def cells(self) -> dict[str, tuple[Path, StreamConfig]]:
        """Return the clip and the settings of each fit, by scene, cameras, `fit.exposure` and the fit's seed."""
        config = StreamConfig()
        work = {name: getattr(self, name) for name in ("num_gaussians", "first_frame_steps", "epochs")}
        found: dict[str, tuple[Path, StreamConfig]] = {}
        for seed in self.seeds:
            for cameras in _ROWS:
                modes: tuple[Literal["off", "auto"], ...] = ("off", "auto")
                for mode in modes:
                    fit = replace(config.fit, exposure=mode, dropping=0.0, **work)
                    for own in self.fit_seeds:
                        name = f"{seed} {cameras} {mode} {own}"
                        found[name] = self.clip(seed, cameras), replace(config, fit=fit, seed=own)
        return found

    def clip(self, seed: int, cameras: str) -> Path:
        """Return the folder of a clip."""
        folder = self.clips / f"random-{seed}-{cameras}"
        if not folder.exists():
            width, height = self.width, self.width * 3 // 4
            own = SynthConfig(7, self.frames, width, height, disturbances=_ROWS[cameras], seed=seed)
            synthesize("random", folder, own)
        return folder


def measure(clip: Path, config: StreamConfig) -> dict[str, float]:
    """Return the scores of a fit."""
    capture = load_capture(clip)
    test, loop, rows, still = capture.test_view, new_loop(capture, config), [], StillVariation(None, 0)
    assert test is not None
    camera, size, seconds = capture.cameras[test], [], []
    for frame in capture.frames():
        _, report = loop.push([frame.images[v] for v in capture.train_views])
        assert loop.gaussians is not None
        color, target = np.asarray(rasterize(loop.gaussians, camera, ("color",)).color), frame.images[test]
        image, recorded = to_uint8(color), target / 255.0
        matched = follow_exposure(image, target)(image / 255.0).clip(0, 1)
        rows.append((psnr(image / 255.0, recorded), psnr(matched, recorded)))
        still.add(image, target, load_truth(clip / "truth", camera.name, frame.index).mask)
        size.append(report.num_bytes)
        seconds.append(report.seconds)
    psnrs = dict(zip(("psnr", "psnr_matched"), np.mean(rows, axis=0).tolist(), strict=True))
    about = {"kb": np.mean(size[1:]) / 1e3, "mtv": still.result().render, "seconds": seconds[0]}
    return {name: float(f"{value:.4g}") for name, value in (psnrs | about).items()}


def exposure_table(fits: Mapping[str, Mapping[str, float]]) -> str:
    """Return the means and the standard deviations of the fits as a table in Markdown."""
    groups: dict[str, list[Mapping[str, float]]] = {}
    for name, row in fits.items():
        groups.setdefault(name.rpartition(" ")[0], []).append(row)

    def written(rows: Sequence[Mapping[str, float]], score: str) -> str:
        values = [row[score] for row in rows]
        return f"{np.mean(values):.2f} ± {np.std(values, ddof=1) if len(values) > 1 else 0:.2f} dB"

    head = "| seed | cameras | `fit.exposure` | as recorded | colours matched | still: mTV x100 | kB per later frame |"
    rows = [
        f"| {' | '.join(name.split())} | {written(of_name, 'psnr')} | {written(of_name, 'psnr_matched')} | "
        f"{np.mean([row['mtv'] for row in of_name]):.3f} | {np.mean([row['kb'] for row in of_name]):.1f} |"
        for name, of_name in groups.items()
    ]
    return "\n".join([head, "|---|---|---|---|---|---|---|", *rows])


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    options.write({"fits": options.run(measure, options.cells())}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
