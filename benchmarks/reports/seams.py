"""PSNR and flicker at the seams of fits in segments, compared with the frames around and with fits in one piece.

    python -m benchmarks.reports.seams --fit-seeds 0 1 2 --json benchmarks/results/seams.json

The settings of the seams were chosen on `arm`, `spheres`, `thin` and `flicker` with seed 0; nothing was chosen on
others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tyro

from benchmarks.reports.fits import ClipOptions
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.codec.reader import StreamReader
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.executor import open_workers, wait_for
from morgs_mi.runs.cluster.seams import SegmentConfig, score_seam
from morgs_mi.runs.cluster.segments import SegmentedRun
from morgs_mi.runs.cluster.tasks import Source

COLUMNS = (
    Column("around, dB", "psnr_around", spread=False),
    Column("in one piece, dB", lambda seam: seam["whole"]["psnr"], spread=False),
    Column("seam - around, dB", lambda seam: seam["psnr"] - seam["psnr_around"]),
    Column("mTV, ratio", lambda seam: seam["mtv"] / seam["mtv_around"]),
    Column("size, ratio", lambda seam: seam["num_bytes"] / seam["num_bytes_whole"], spread=False),
)


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips and work."""

    scenes: tuple[tuple[str, int, int], ...] = (
        ("arm", 0, 48),
        ("random", 5, 32),
        ("random", 34, 32),
        ("random", 35, 32),
        ("thin", 0, 32),
        ("flicker", 0, 32),
        ("spheres", 0, 32),
    )
    """Scenes, seeds and numbers of frames."""
    cameras: int = 6
    """Cameras of a clip, one of them held out."""
    steps: int | None = 500
    """Steps of the first frame."""
    epochs: int = 2
    """Epochs of a later frame."""
    segment_frames: int = 16
    """Frames of a segment."""

    def study(self) -> Study:
        """Return the study of the clips; every cell has a row for each seam."""
        scenes = []
        for scene, seed, frames in self.scenes:
            name = f"{scene}-{seed}-{self.cameras}"
            clip = self.clip(scene, name, cameras=self.cameras, frames=frames, seed=seed)
            keys = {"scene": scene, "seed": seed, "frames": frames}
            scenes.append(Scene(keys, (Source.of(clip), frames // self.segment_frames)))
        return Study(measure, scenes, [Variant({}, self.config(dropping=0.0))], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the seams: each against the frames around, and beside the fit in one piece."""
        keys = {"clip": lambda seam: f"`{seam['scene']}` {seam['seed']}", "frame": "frame"}
        return scores_table(rows, keys, COLUMNS)


def measure(source: Source, num_segments: int, config: StreamConfig) -> list[dict[str, Any]]:
    """Return the scores of the seams, of a fit in one piece at the same frames, and the sizes of both in bytes."""
    capture = source.open()
    with TemporaryDirectory() as name, open_workers(count=1) as workers:
        segments, whole = (Path(name) / part for part in ("segments", "whole"))
        fit = wait_for(SegmentedRun(capture, segments, workers, config, SegmentConfig(num_segments)).fit())
        wait_for(SegmentedRun(capture, whole, workers, config).fit())
        streams = [folder / "stream.morgs" for folder in (segments, whole)]
        same = [score_seam(StreamReader(streams[1]), capture, seam.frame) for seam in fit.seams]
        sizes = dict(zip(("num_bytes", "num_bytes_whole"), (path.stat().st_size for path in streams), strict=True))
    return [{**asdict(seam), "whole": asdict(other), **sizes} for seam, other in zip(fit.seams, same, strict=True)]


if __name__ == "__main__":
    tyro.cli(Options).run()
