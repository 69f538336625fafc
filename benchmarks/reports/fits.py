"""Shared by the reports on fits: clips of synthetic scenes, loops over a capture's views, and their
fits.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from morgs_mi import StreamLoop
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.container import Packet, StreamWriter
from morgs_mi.codec.packets import coded_frames
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.results import Evaluation
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig

DEFAULT = "default"  # name of the settings without a preset


def synthetic(scene: str | Path, clip: Path, config: SynthConfig, downscale: float = 1) -> Capture:
    """Return the clip of a scene, which is made by `synthesize` if it is not there."""
    if not clip.exists():
        synthesize(scene, clip, config)
    return load_capture(clip, downscale)


def random_capture(clips: Path, seed: int, downscale: float = 1) -> Capture:
    """Return the random scene of a seed, which is made in the folder `clips` if it is not there."""
    return synthetic(
        "random", clips / f"random-{seed}", SynthConfig(frames=8, seed=seed), downscale
    )


def new_loop(capture: Capture, config: StreamConfig) -> StreamLoop:
    """Return a loop over the training views of a capture."""
    return StreamLoop(capture.views.train, capture.points, capture.point_colors, config)


@dataclass(frozen=True, eq=False)
class Clip:
    """A capture with its images in memory."""

    capture: Capture
    images: tuple[tuple[np.ndarray, ...], ...]  # by frame and training view, uint8 [H, W, 3]

    @classmethod
    def read(cls, capture: Capture) -> Clip:
        """Return a capture with its images decoded."""
        frames = capture.frames()
        return cls(capture, tuple(tuple(view.image for view in f.train) for f in frames))

    def continued(self, keyframe: Packet, config: StreamConfig) -> Continuation:
        """Fit all later frames after the packet of the first one."""
        capture = self.capture
        metadata = {"capture": str(capture.path.resolve()), "downscale": capture.downscale}
        metadata |= {"test_view": list(capture.test_views), "config": asdict(config)}
        loop = new_loop(capture, config)
        (coded,) = coded_frames([keyframe])
        loop.resume(coded, self.images[:1])
        packets = [keyframe]
        reports = []
        seconds = []
        with TemporaryDirectory() as folder:
            path = Path(folder) / "stream.morgs"
            with StreamWriter(path, capture.cameras, capture.fps, metadata) as writer:
                writer.write(keyframe)
                for images in self.images[1:]:
                    start = time.process_time()
                    packet, report = loop.push(images)
                    seconds.append(time.process_time() - start)
                    writer.write(packet)
                    packets.append(packet)
                    reports.append(report)
            evaluation = evaluate_stream(path, capture.path)
        return Continuation(evaluation, packets, reports, seconds)


class Continuation(NamedTuple):
    """The later frames of a clip."""

    evaluation: Evaluation  # of the whole stream
    packets: list[Packet]  # of all frames
    reports: list[FrameReport]  # of the later frames
    seconds: list[float]  # processor times of the later frames, s
